"""Specular field -> octahedral atlas: the MLP's outputs for clusters of colours, or for nodes of a grid, as maps."""

from __future__ import annotations

from itertools import pairwise
from typing import Any, Literal, NamedTuple, TypedDict

import numpy as np
import numpy.typing as npt

from nerfbake import memory, progress
from nerfbake.errors import InvalidScene, Problem
from nerfbake.kernels.arrays import Floats
from nerfbake.kernels.cluster.colours import CODES, codes_of, colours_of, runs
from nerfbake.kernels.maths.elementary import fibonacci
from nerfbake.kernels.maths.linear import product, solve_banded, solve_each
from nerfbake.kernels.surface import mlp, octahedron
from nerfbake.scene.atlas import MAX_MAP_SIZE, MAX_TILES, ZERO_OFFSET, ZERO_SLOPE, Method, OctahedralAtlas, tetrahedron
from nerfbake.scene.stage1 import SpecularField
from nerfbake.stages.specular_to_clusters import (
    FLATNESS,
    Clusters,
    Identifiers,
    cluster_identifiers,
    cluster_planes,
    identify_colours,
)

_OUTPUTS = 1 << 22  # outputs of the MLP at a time: 16 MB
_NODE_WEIGHT = 1e-4  # regularisation of a grid's node towards the MLP's outputs there, if colours do not determine it


def bake_snapped_maps(field: SpecularField, identifiers: Identifiers, clusters: Clusters, *, map_size: int) -> Floats:
    """Return maps (K, R, R, 3) in 0..1 of the MLP's outputs for the colour that represents each cluster.

    >>> import numpy as np
    >>> from nerfbake import bake_snapped_maps, cluster_identifiers, identify_colours, sample_stage1
    >>> field = sample_stage1(resolution=16).fields[0]
    >>> identifiers = identify_colours(field, directions=np.eye(3))
    >>> clusters = cluster_identifiers(identifiers, clusters=4)
    >>> bake_snapped_maps(field, identifiers, clusters, map_size=8).shape
    (4, 8, 8, 3)
    """
    return _as_maps(_outputs(field, identifiers.features[clusters.members], map_size), map_size)


def bake_mean_maps(field: SpecularField, identifiers: Identifiers, clusters: Clusters, *, map_size: int) -> Floats:
    """Return maps (K, R, R, 3) in 0..1 of the mean of the MLP's outputs over each cluster's texels."""
    groups = _group(identifiers, clusters.labels)
    maps = np.empty((clusters.K, 3 * map_size**2))
    for k, (features, weight) in enumerate(groups):
        maps[k] = _moments(field, features, weight, np.ones((len(features), 1)), map_size).right[0] / weight.sum()
    return _as_maps(maps, map_size)


class AffineMaps(NamedTuple):
    """Maps of an affine function from feature to colour, for each cluster."""

    maps: Floats  # (4 K, R, R, 3): the colour at the centre 0..1, then its slopes along red, green and blue
    centres: npt.NDArray[np.int64]  # (K, 3) 0..255


def bake_affine_maps(
    field: SpecularField, identifiers: Identifiers, clusters: Clusters, *, map_size: int
) -> AffineMaps:
    """Fit M0 + sum J_i (f - c)_i to the MLP's outputs by least squares, for each cluster; f in 0..1.

    The centre c is the cluster's mean, moved as far as necessary for all offsets to fit into a byte without loss.
    """
    box = np.array([[255] * 3, [0] * 3])[:, None].repeat(clusters.K, axis=1)
    bytes_ = colours_of(identifiers.codes)
    np.minimum.at(box[0], clusters.labels, bytes_)
    np.maximum.at(box[1], clusters.labels, bytes_)
    centres = np.clip(_means(identifiers, clusters), box[1] - (255 - ZERO_OFFSET), box[0] + ZERO_OFFSET)
    maps = np.empty((clusters.K, 4, 3 * map_size**2))
    for k, (features, weight) in progress.each(list(enumerate(_group(identifiers, clusters.labels)))):
        design = np.insert(features - centres[k] / 255, 0, 1, axis=1)
        left, right = _moments(field, features, weight, design, map_size)
        left += weight.sum() * FLATNESS * np.diag([0, 1, 1, 1])
        maps[k] = solve_each(left[None], right[None])[0]
    return AffineMaps(_as_maps(maps.reshape(4 * clusters.K, -1), map_size), centres)


def _means(identifiers: Identifiers, clusters: Clusters) -> npt.NDArray[np.int64]:
    """Return the mean colour (K, 3) of each cluster's texels, rounded to 0..255."""
    weight = np.bincount(clusters.labels, identifiers.counts)
    sums = [np.bincount(clusters.labels, identifiers.counts * channel) for channel in identifiers.features.T]
    return np.rint(255 * np.stack(sums, axis=1) / weight[:, None]).astype(np.int64)


def bake_grid_maps(field: SpecularField, identifiers: Identifiers, *, nodes: int, map_size: int) -> Floats:
    """Return maps (n^3, R, R, 3) in 0..1 of a grid's nodes, fitted to the MLP's outputs for colours between them."""
    axis = np.arange(nodes) / (nodes - 1)
    at_nodes = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    pull = _NODE_WEIGHT * identifiers.counts.sum() / nodes**3
    steps = np.array([0, 1, nodes, nodes + 1])
    steps = np.concatenate([steps, steps + nodes**2])
    # Only nodes of the same cube are coupled, so the bandwidth of the matrix is the offset along a cube's diagonal.
    left, right = np.zeros((nodes**3, steps[-1] + 1)), pull * _outputs(field, at_nodes, map_size)
    left[:, 0] = pull
    low, high = np.tril_indices(len(steps))
    cubes, labels = np.unique(tetrahedron(colours_of(identifiers.codes), nodes)[0][:, 0], return_inverse=True)
    for cube, (features, weight) in progress.each(list(zip(cubes, _group(identifiers, labels), strict=True))):
        index, share = tetrahedron(255 * features, nodes)
        corners = cube + steps
        design = np.zeros((len(features), 8))
        np.put_along_axis(design, np.searchsorted(corners, index), share, axis=1)
        moments = _moments(field, features, weight, design, map_size)
        left[corners[low], steps[low] - steps[high]] += moments.left[low, high]
        right[corners] += moments.right
    return _as_maps(solve_banded(left, right), map_size)


class _Moments(NamedTuple):
    """The normal equations of a weighted least-squares fit."""

    left: Floats  # (c, c)
    right: Floats  # (c, 3 R^2)


def _moments(field: SpecularField, features: Floats, weight: Floats, design: Floats, map_size: int) -> _Moments:
    """Return the normal equations for factors (g, c) and the MLP's outputs for features (g, 3) in all texels."""
    weighted = design * weight[:, None]
    right = np.zeros((design.shape[1], 3 * map_size**2))
    directions, step = octahedron.texel_directions(map_size), max(1, _OUTPUTS // right.shape[1])
    for start in range(0, len(features), step):
        part = slice(start, start + step)
        outputs = mlp.evaluate(features[part], directions, *field.mlp)
        right += product(weighted[part].T, outputs.reshape(-1, right.shape[1]))
    return _Moments(product(weighted.T, design), right)


def _group(identifiers: Identifiers, labels: npt.NDArray[np.integer[Any]]) -> list[tuple[Floats, Floats]]:
    """Return for each label the features (g, F) and weights (g,) of its colours, averaged over small cells of colours.

    The MLP is almost linear within a cell: 30,000 cells replace 1.4 million colours.
    """
    cell_bits = identifiers.channels * identifiers.cell_bits
    keys = labels.astype(np.int64) << cell_bits | identifiers.cells_of(identifiers.cell_bits).astype(np.int64)
    order = np.argsort(keys, kind="stable")
    keys, counts = keys[order], identifiers.counts[order]
    start = runs(keys)[:-1]
    weight = np.add.reduceat(counts, start)
    sums = [np.add.reduceat(counts * channel, start) for channel in identifiers.features[order].T]
    features = np.stack(sums, axis=1) / weight[:, None]
    ends = runs(keys[start] >> cell_bits)
    return [(features[a:b], weight[a:b]) for a, b in pairwise(ends)]


def _outputs(field: SpecularField, features: Floats, map_size: int) -> Floats:
    """Return the MLP's outputs (m, 3 R^2) for features (m, F) in every texel's direction."""
    directions, out = octahedron.texel_directions(map_size), np.empty((len(features), 3 * map_size**2))
    step = max(1, _OUTPUTS // out.shape[1])
    for start in range(0, len(features), step):
        part = slice(start, start + step)
        out[part] = mlp.evaluate(features[part], directions, *field.mlp).reshape(-1, out.shape[1])
    return out


def _as_maps(values: Floats, map_size: int) -> Floats:
    """Reshape values (m, 3 R^2), channel by channel, to maps (m, R, R, 3)."""
    return values.reshape(-1, 3, map_size, map_size).transpose(0, 2, 3, 1)


MAX_CUBE_NODES = 16
_IDENTIFIED, _CLUSTERED = 0.6, 0.9  # progress when the colours have identifiers, and clusters
_TEXEL_BYTES = 3 * 4 * 8  # per texel: its channels, in up to four float64 copies at a time
# Bytes per texel of the texture while its label and, for affine, its offset from a centre are computed (72 measured).
_LABEL_BYTES = {"kmeans": 32, "affine": 96, "grid": 32}
Centres = Literal["snapped", "mean"]


class AtlasOptions(TypedDict, total=False):
    """Options of bake_atlas() for callers that pass them on; directions are separate."""

    method: Method
    clusters: int
    map_size: int
    centres: Centres
    nodes: int
    border: int
    seed: int


def bake_atlas(
    field: SpecularField,
    *,
    method: Method = "kmeans",
    clusters: int = 64,
    map_size: int = 64,
    directions: npt.NDArray[np.float64] | None = None,
    direction_weights: npt.NDArray[np.float64] | None = None,
    centres: Centres = "snapped",
    nodes: int = 7,
    border: int = 1,
    seed: int = 0,
) -> OctahedralAtlas:
    """Bake a field's MLP into an atlas. For the methods see OctahedralAtlas.

    clusters: K, for kmeans and affine. nodes: number along each axis of feature space, for grid. directions (N, 3):
    unit vectors in which colours are compared; None: 100 evenly spread ones. direction_weights (N,): weight of each
    direction, 1 on average. centres: maps of kmeans store the snapped colour, or the mean of the cluster. The same
    arguments give the same bytes on every CPU, for any number of threads. Raises InvalidScene for sizes out of range
    and for more clusters than colours, MemoryLimit if the maps need too much memory.

    >>> from nerfbake import bake_atlas, sample_stage1
    >>> field = sample_stage1(resolution=16).fields[0]
    >>> print(bake_atlas(field, clusters=4, map_size=8))
    kmeans atlas of 4 maps of 8x8
    >>> print(bake_atlas(field, method="grid", nodes=2, map_size=8))
    grid atlas of 8 maps of 8x8
    """
    for name, value, low, high in (
        ("map size", map_size, 2, MAX_MAP_SIZE),
        ("nodes", nodes, 2, MAX_CUBE_NODES),
        ("border", border, 0, map_size // 2),
    ):
        if not low <= value <= high:
            raise InvalidScene(Problem(name, f"is {value}", f"{low} to {high}"))
    if method != "kmeans" and field.channels != 3:
        raise InvalidScene(Problem("method", f"is {method}", f"kmeans for {field.channels} features; others need 3"))
    if method == "affine" and clusters > MAX_TILES // 4:
        raise InvalidScene(Problem("clusters", f"is {clusters:,}", f"1 to {MAX_TILES // 4:,}, of 4 maps each"))
    count = {"kmeans": clusters, "affine": 4 * clusters, "grid": nodes**3}[method]
    memory.require(f"{count:,} maps of {map_size}x{map_size}", count * map_size**2 * _TEXEL_BYTES)
    memory.require("the texture's labels", field.used.size * _LABEL_BYTES[method])
    directions = fibonacci(100) if directions is None else directions
    with progress.part(0, _IDENTIFIED):
        identifiers = identify_colours(field, directions=directions, direction_weights=direction_weights)
    if method == "grid":
        with progress.part(_IDENTIFIED, 1):
            maps = bake_grid_maps(field, identifiers, nodes=nodes, map_size=map_size)
        labels = np.zeros(field.used.shape, np.uint16)
        return OctahedralAtlas("grid", _bytes(255 * maps), labels, field.features, border)
    find = cluster_planes if method == "affine" else cluster_identifiers
    with progress.part(_IDENTIFIED, _CLUSTERED):
        found = find(identifiers, clusters=clusters, seed=seed)
    labels = label_texels(field, identifiers, found)
    if method == "affine":
        with progress.part(_CLUSTERED, 1):
            affine = bake_affine_maps(field, identifiers, found, map_size=map_size)
        offsets = _bytes(field.features - affine.centres[labels] + ZERO_OFFSET)
        tiles, slope, slopes = _encode_affine(affine.maps)
        return OctahedralAtlas("affine", tiles, labels, offsets, border, slope, slopes)
    make = bake_mean_maps if centres == "mean" else bake_snapped_maps
    return OctahedralAtlas(
        "kmeans", _bytes(255 * make(field, identifiers, found, map_size=map_size)), labels, border=border
    )


def label_texels(field: SpecularField, identifiers: Identifiers, clusters: Clusters) -> npt.NDArray[np.uint16]:
    """Return the cluster (H, W) of each texel's colour, or 0 for colours of unused texels only."""
    codes = codes_of(field.features)
    if field.channels > 3:  # too many codes for a table
        place = np.minimum(np.searchsorted(identifiers.codes, codes), len(identifiers.codes) - 1)
        return np.where(identifiers.codes[place] == codes, clusters.labels[place], 0).astype(np.uint16)
    table = np.zeros(CODES, np.uint16)
    table[identifiers.codes] = clusters.labels
    return table[codes]


class _Encoded(NamedTuple):
    tiles: npt.NDArray[np.uint8]
    slope: float
    slopes: npt.NDArray[np.uint8]


def _encode_affine(maps: npt.NDArray[np.float64]) -> _Encoded:
    """Quantise slopes to bytes with one scale per cluster. Few clusters are steep: one scale for all clusters would
    increase the MSE by 1.6 at K = 256."""
    by_cluster = maps.reshape(-1, 4, *maps.shape[1:])
    steepest = np.abs(by_cluster[:, 1:]).max(axis=(1, 2, 3, 4))
    slope = max(float(steepest.max()), 1e-6)
    slopes = np.maximum(np.ceil(steepest / slope * 255), 1).astype(np.uint8)
    encoded = np.empty(by_cluster.shape, np.uint8)
    encoded[:, 0] = _bytes(255 * by_cluster[:, 0])
    scale = (127 * 255 / slope / slopes)[:, None, None, None, None]
    encoded[:, 1:] = _bytes(by_cluster[:, 1:] * scale + ZERO_SLOPE)
    return _Encoded(encoded.reshape(maps.shape), slope, slopes)


def _bytes(values: npt.NDArray[Any]) -> npt.NDArray[np.uint8]:
    whole: npt.NDArray[np.uint8] = np.clip(np.rint(values), 0, 255).astype(np.uint8)
    return whole
