"""Clusters of colours, or nodes of a grid -> octahedral maps of what the MLP shows for them."""

from __future__ import annotations

from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake import progress
from nerfbake.kernels.arrays import Floats
from nerfbake.kernels.cluster import colours
from nerfbake.kernels.maths.equations import solve_banded, solve_each
from nerfbake.kernels.maths.products import product
from nerfbake.kernels.surface import mlp, octahedron
from nerfbake.scene.atlas import ZERO_OFFSET, tetrahedron
from nerfbake.scene.specular import SpecularField
from nerfbake.stages.identifiers_to_clusters import FLATNESS, Clusters
from nerfbake.stages.specular_to_identifiers import Identifiers

_OUTPUTS = 1 << 22  # of the MLP at a time: 16 MB
_CELL_BITS = 5  # colours of a cell of 5-bit colour stand together in a fit
_NODE_WEIGHT = 1e-4  # pull of a grid's node towards the MLP's own outputs there, for what no colour settles


def bake_snapped_maps(field: SpecularField, identifiers: Identifiers, clusters: Clusters, *, map_size: int) -> Floats:
    """(K, R, R, 3) what the MLP shows for the colour that stands for each cluster, 0..1.

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
    """(K, R, R, 3) the mean of what the MLP shows for each cluster's texels, 0..1."""
    groups = _group(identifiers, clusters.labels)
    maps = np.empty((clusters.K, 3 * map_size**2))
    for k, (features, weight) in enumerate(groups):
        maps[k] = _moments(field, features, weight, np.ones((len(features), 1)), map_size).right[0] / weight.sum()
    return _as_maps(maps, map_size)


class AffineMaps(NamedTuple):
    """A colour that follows the feature, for each cluster."""

    maps: Floats  # (4 K, R, R, 3): the colour at the centre 0..1, then its slopes along red, green and blue
    centres: npt.NDArray[np.int64]  # (K, 3) 0..255


def bake_affine_maps(
    field: SpecularField, identifiers: Identifiers, clusters: Clusters, *, map_size: int
) -> AffineMaps:
    """Per cluster the least-squares fit of M0 + sum J_i (f - c)_i to what the MLP shows, f in 0..1.

    The centre c is the cluster's mean, moved as far as it takes for every offset to fit a byte without loss.
    """
    box = np.array([[255] * 3, [0] * 3])[:, None].repeat(clusters.K, axis=1)
    bytes_ = colours.colours_of(identifiers.codes)
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
    """(K, 3) the mean colour of each cluster's texels, rounded to 0..255."""
    weight = np.bincount(clusters.labels, identifiers.counts)
    sums = [np.bincount(clusters.labels, identifiers.counts * channel) for channel in identifiers.features.T]
    return np.rint(255 * np.stack(sums, axis=1) / weight[:, None]).astype(np.int64)


def bake_grid_maps(field: SpecularField, identifiers: Identifiers, *, nodes: int, map_size: int) -> Floats:
    """(n^3, R, R, 3) the nodes' maps, 0..1, that fit best what the MLP shows for the colours between them."""
    axis = np.arange(nodes) / (nodes - 1)
    at_nodes = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    pull = _NODE_WEIGHT * identifiers.counts.sum() / nodes**3
    steps = np.array([0, 1, nodes, nodes + 1])
    steps = np.concatenate([steps, steps + nodes**2])
    # Nodes meet in cubes alone: what belongs to two of them is at most a cube's diagonal away from the diagonal.
    left, right = np.zeros((nodes**3, steps[-1] + 1)), pull * _outputs(field, at_nodes, map_size)
    left[:, 0] = pull
    low, high = np.tril_indices(len(steps))
    cubes, labels = np.unique(tetrahedron(colours.colours_of(identifiers.codes), nodes)[0][:, 0], return_inverse=True)
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
    """Of (g, c) factors against what the MLP shows for (g, 3) features in every texel's direction."""
    weighted = design * weight[:, None]
    right = np.zeros((design.shape[1], 3 * map_size**2))
    directions, step = octahedron.texel_directions(map_size), max(1, _OUTPUTS // right.shape[1])
    for start in range(0, len(features), step):
        part = slice(start, start + step)
        outputs = mlp.evaluate(features[part], directions, field.w0, field.w1)
        right += product(weighted[part].T, outputs.reshape(-1, right.shape[1]))
    return _Moments(product(weighted.T, design), right)


def _group(identifiers: Identifiers, labels: npt.NDArray[np.integer[Any]]) -> list[tuple[Floats, Floats]]:
    """Per label the mean features (g, 3) and weights (g,) of its colours, those of a small cell of colours as one.

    What the MLP shows hardly bends within a cell: 30,000 cells stand for 1.4 million colours.
    """
    cell_bits = 3 * _CELL_BITS
    keys = labels.astype(np.int64) << cell_bits | identifiers.codes >> np.uint32(24 - cell_bits)
    order = np.argsort(keys, kind="stable")
    keys, counts = keys[order], identifiers.counts[order]
    start = colours.runs(keys)[:-1]
    weight = np.add.reduceat(counts, start)
    sums = [np.add.reduceat(counts * channel, start) for channel in identifiers.features[order].T]
    features = np.stack(sums, axis=1) / weight[:, None]
    ends = colours.runs(keys[start] >> cell_bits)
    return [(features[a:b], weight[a:b]) for a, b in pairwise(ends)]


def _outputs(field: SpecularField, features: Floats, map_size: int) -> Floats:
    """(m, 3 R^2) what the MLP shows for (m, 3) features in every texel's direction."""
    directions, out = octahedron.texel_directions(map_size), np.empty((len(features), 3 * map_size**2))
    step = max(1, _OUTPUTS // out.shape[1])
    for start in range(0, len(features), step):
        part = slice(start, start + step)
        out[part] = mlp.evaluate(features[part], directions, field.w0, field.w1).reshape(-1, out.shape[1])
    return out


def _as_maps(values: Floats, map_size: int) -> Floats:
    """(m, 3 R^2), channel by channel -> (m, R, R, 3)."""
    return values.reshape(-1, 3, map_size, map_size).transpose(0, 2, 3, 1)
