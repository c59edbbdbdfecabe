"""Specular field -> octahedral atlas: the MLP baked into maps that a shader only has to look up."""

from __future__ import annotations

from typing import Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake import memory, progress
from nerfbake.errors import InvalidScene, Problem
from nerfbake.kernels.cluster import colours
from nerfbake.kernels.maths.sphere import fibonacci
from nerfbake.scene.atlas import MAX_MAP_SIZE, MAX_TILES, ZERO_OFFSET, ZERO_SLOPE, Method, OctahedralAtlas
from nerfbake.scene.specular import SpecularField
from nerfbake.stages.clusters_to_maps import bake_affine_maps, bake_grid_maps, bake_mean_maps, bake_snapped_maps
from nerfbake.stages.identifiers_to_clusters import Clusters, cluster_identifiers, cluster_planes
from nerfbake.stages.specular_to_identifiers import Identifiers, identify_colours

MAX_CUBE_NODES = 16
_IDENTIFIED, _CLUSTERED = 0.6, 0.9  # of the work is done when colours have identifiers, and clusters
_TEXEL_BYTES = 3 * 4 * 8  # a texel's channels, in up to four float64 copies at a time
# A texel of the texture, while its colour is looked up and, for affine, its distance from a centre taken (72 measured).
_LABEL_BYTES = {"kmeans": 32, "affine": 96, "grid": 32}
Centres = Literal["snapped", "mean"]


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
    """The atlas that comes closest to the field's MLP: OctahedralAtlas says what the methods are.

    clusters: K, for kmeans and affine; nodes: along each axis of feature space, for grid. directions (N, 3): unit,
    those in which colours are compared, 100 evenly spread ones unless given; direction_weights (N,): how much each
    counts, 1 on average. centres: kmeans' maps show the snapped colour, or the mean of the cluster. The same arguments
    give the same bytes on every CPU, whatever the number of threads. Raises InvalidScene for sizes out of range and
    more clusters than colours, MemoryLimit for maps that would take too much while they are made.

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
    """(H, W) the cluster of each texel's colour; 0 where only unused texels have it."""
    table = np.zeros(colours.CODES, np.uint16)
    table[identifiers.codes] = clusters.labels
    return table[colours.codes_of(field.features)]


class _Encoded(NamedTuple):
    tiles: npt.NDArray[np.uint8]
    slope: float
    slopes: npt.NDArray[np.uint8]


def _encode_affine(maps: npt.NDArray[np.float64]) -> _Encoded:
    """Slopes as bytes, on a scale for each cluster: few are steep; one scale for all costs 1.6 in MSE at K = 256."""
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
