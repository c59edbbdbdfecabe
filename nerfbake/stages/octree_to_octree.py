"""Sparse voxel octree -> the same octree at a coarser level of detail, or in a smaller basis."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from nerfbake import memory
from nerfbake.errors import InvalidScene, Problem
from nerfbake.kernels.maths.linear import product, solve_each
from nerfbake.scene.basis import SH_SIZES, parse_basis, renderable_basis
from nerfbake.scene.octree import SparseVoxelOctree

_CHUNK = 1 << 15  # nodes at a time


def cut_octree(octree: SparseVoxelOctree, *, level: int) -> SparseVoxelOctree:
    """Cut an octree at a level: nodes of that level become leaves and keep their values.

    level: 0 (only the root) to the level of single voxels. The grid gets one voxel for each node of that level, at the
    same place in the world. In both layouts the result is the first part of the octree's arrays; no value is computed.
    Source: TR-24-01 (docs/sources.md), 5.1.

    >>> from nerfbake import build_octree, cut_octree, sample_n3tree
    >>> octree = build_octree(sample_n3tree(resolution=8))
    >>> len(octree.level_sizes), len(cut_octree(octree, level=1).level_sizes)
    (4, 2)
    """
    if not 0 <= level <= octree.grid_level:
        raise InvalidScene(Problem("level", f"is {level}", f"0 to {octree.grid_level}, the level of single voxels"))
    sizes = octree.level_sizes[: level + 1]
    n, above_last = sum(sizes), sum(sizes[:-1])
    children = octree.node_children[:above_last]
    step = 1 << (octree.grid_level - level)
    w, h, d = (-(-edge // step) for edge in octree.size)
    cut = replace(
        octree,
        size=(w, h, d),
        node_children=children,
        node_data=octree.node_data[:n],
        voxel_size=octree.voxel_size * step,
    )
    return cut.with_layout(octree.layout)


def require_lower(octree: SparseVoxelOctree, basis: str) -> None:
    """Raise InvalidScene for a basis that lower_basis() cannot convert the octree to."""
    own = renderable_basis(octree.data_format)
    lower = [f"SH{size}" for size in SH_SIZES if own.kind == "SH" and size < own.size]
    if basis not in (str(own), *lower):
        found = f"is {basis[:40]} for an octree of {own}"
        raise InvalidScene(Problem("the basis", found, ", ".join(lower) or str(own)))


def lower_basis(octree: SparseVoxelOctree, basis: str, gram: npt.NDArray[np.float64]) -> SparseVoxelOctree:
    """Convert an octree to SHk of a lower degree, by a least-squares fit of the colours before the sigmoid.

    gram (B, B): Importance.gram of weigh_leaves(), which weights the directions of the fit. An octree that has this
    basis already is returned unchanged. Raises InvalidScene for a basis that is not SHk or has more coefficients than
    the octree's, MemoryLimit.

    >>> from nerfbake import build_field, build_octree, lower_basis, sample_n3tree, scatter_cameras, weigh_leaves
    >>> octree = build_octree(sample_n3tree(resolution=16))
    >>> field = build_field(octree)
    >>> gram = weigh_leaves(field, scatter_cameras(field, frames=8, edge=64)).gram
    >>> print(lower_basis(octree, "SH4", gram))
    SH4 octree of 16x16x16, 716 nodes, float32, full
    """
    require_lower(octree, basis)
    own, lower = renderable_basis(octree.data_format), parse_basis(basis)
    if lower == own:
        return octree
    k = lower.size
    fit = np.ascontiguousarray(solve_each(gram[None, :k, :k], gram[None, :k])[0].T)
    memory.require("the octree in another basis", octree.n * lower.data_dim * octree.node_rows.dtype.itemsize)
    data = np.empty((octree.n, lower.data_dim), octree.node_rows.dtype)
    for first in range(0, octree.n, _CHUNK):
        some = slice(first, first + _CHUNK)
        values = octree.node_rows[some]
        for c in range(3):
            data[some, c * k : (c + 1) * k] = product(values[:, c * own.size : (c + 1) * own.size], fit)
        data[some, -1] = values[:, -1]
    return memory.kept(replace(octree, node_data=data, data_format=basis))
