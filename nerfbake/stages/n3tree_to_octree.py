"""PlenOctree (N3Tree) -> sparse voxel octree: TR-24-01 (docs/sources.md), 3.2 and 3.3."""

from __future__ import annotations

from typing import Literal

import numpy as np

from nerfbake import memory
from nerfbake.errors import InvalidScene, Problem
from nerfbake.kernels.octree.lockstep import Room, Source, refine
from nerfbake.kernels.octree.means import mean_edge
from nerfbake.kernels.octree.node_values import NodeRows
from nerfbake.kernels.octree.pyramid import children_table, drop_empty, merge_equal
from nerfbake.scene.n3tree import N3Tree
from nerfbake.scene.octree import MAX_SIZE, Layout, SparseVoxelOctree
from nerfbake.stages._leaf_values import LeafValues

_PER_CELL = 8  # bytes of a cell's density and link
Resample = Literal["mean", "nearest"]


def build_octree(
    tree: N3Tree,
    *,
    resolution: int | tuple[int, int, int] | None = None,
    resample: Resample = "mean",
    layout: Layout = "full",
    dtype: Literal["float32", "float16"] = "float32",
    sigma_min: float | None = None,
) -> SparseVoxelOctree:
    """The tree resampled to a grid of W x H x D voxels over its cube, as a breadth-first octree.

    resolution: one edge or (W, H, D), 1 to 4096; None is the tree's own finest. Where a voxel covers several
    leaves, `nearest` reads the one that holds its centre (on a boundary the upper one, as the report's program
    does), and `mean` takes the mean density of its volume and the opacity-weighted mean of the coefficients
    (kernels.octree.means says how). Where it covers one, both copy that leaf's values exactly.

    Leaves whose density is 0 or less, or below sigma_min (1/world unit), are empty space; without a sigma_min a
    density below 0 is an error. Empty regions have no nodes; regions of exactly equal values are one leaf. An
    internal node holds the same mean of all the leaves below it, empty space included as density 0, so that any
    level can be shown. The float32 values of leaves are copied from the tree when they are asked for.

    Raises InvalidScene if the tree is broken, holds values that no renderer can use, or stands in NDC; MemoryLimit.

    >>> from nerfbake import build_octree, sample_n3tree
    >>> octree = build_octree(sample_n3tree(resolution=16), resolution=8)
    >>> octree.size, octree.grid_level, octree.data_format
    ((8, 8, 8), 3, 'SH9')
    """
    size = _grid_size(tree, resolution)
    if resample not in ("mean", "nearest"):
        raise InvalidScene(Problem("resample", f"is {resample!r}", "mean, nearest"))
    if sigma_min is not None and not sigma_min >= 0:
        raise InvalidScene(Problem("sigma_min", f"is {sigma_min:g}", "0 or more"))
    _require_usable(tree, sigma_min)
    with memory.lent("the tree's densities and links", _PER_CELL * tree.n * tree.N**3):
        source = _source(tree, sigma_min or 0.0)
        room = _room(tree.data_dim, layout, dtype)
        levels, mixed = refine(source, size, centres=resample == "nearest", room=room)
        leaves = LeafValues(tree, source.density, _finest_width(tree), np.dtype(dtype))
        if (levels[-1].leaf >= source.link.size).any():
            leaves.add_means(source, mixed, size)
    del source  # its links are not needed any more, and take room
    levels = merge_equal(drop_empty(levels, leaves.hold), leaves.same)
    values = NodeRows(levels, leaves)
    octree = SparseVoxelOctree(
        size=size,
        node_children=children_table(levels, all_slots=layout == "full"),
        # float16 may not hold a value, which is to be said here; float32 holds all, and is made when it is asked for.
        node_data=values if dtype == "float32" else np.asarray(values),
        data_format=tree.data_format,
        origin=-tree.offset / tree.invradius,
        voxel_size=1 / (tree.invradius * size),
        extra_data=tree.extra_data,
    )
    return memory.kept(octree)


def _room(data_dim: int, layout: Layout, dtype: str) -> Room:
    """What nodes take: 24 bytes while they are made, their child slots, and the values that are kept.

    Of float32 those are the means alone, since leaves stay in the tree; float16 keeps a row of every node.
    """
    mean, slots = 4 * data_dim + 8, 8 * 4
    node = 24 + (slots if layout == "full" else 0) + (0 if dtype == "float32" else 2 * data_dim)
    return Room(node=node, inner=mean + (0 if layout == "full" else slots))


# -- what may be read ------------------------------------------------------------------------------------------
def _grid_size(tree: N3Tree, resolution: int | tuple[int, int, int] | None) -> tuple[int, int, int]:
    if resolution is None:
        if tree.resolution > MAX_SIZE:
            raise InvalidScene(
                Problem("the tree", f"has {tree.resolution} cells an axis", f"a `resolution` of 1 to {MAX_SIZE}")
            )
        resolution = tree.resolution
    w, h, d = (resolution,) * 3 if isinstance(resolution, int) else resolution
    if not all(1 <= edge <= MAX_SIZE for edge in (w, h, d)):
        raise InvalidScene(Problem("resolution", f"is {w}x{h}x{d}", f"1 to {MAX_SIZE} voxels an axis"))
    return w, h, d


def _require_usable(tree: N3Tree, sigma_min: float | None) -> None:
    if tree.ndc:
        found = "marks a forward-facing scene (NDC), whose cube is no box of the world"
        raise InvalidScene(Problem("its _poses_bounds.npy", found, "scenes in world coordinates"))
    for problem in tree.value_problems(negative_is_empty=sigma_min is not None):
        raise InvalidScene(problem)


def _finest_width(tree: N3Tree) -> float:
    """The width of a cell of the deepest level in world units: the geometric mean of its three edges."""
    # Step by step as octree_of_volume works it out from voxel sizes, so that both make the same means to the bit.
    return mean_edge(1 / (np.abs(tree.invradius) * tree.resolution))


def _source(tree: N3Tree, sigma_min: float) -> Source:
    """The tree for descents: links only to nodes that hold something, densities only where a leaf does."""
    sigma = tree.sigma.reshape(-1)
    density = np.where(tree.leaf_mask.reshape(-1) & (sigma > 0) & (sigma >= sigma_min), sigma, np.float32(0))
    holds = np.any(density.reshape(tree.n, -1) > 0, axis=1)
    link = np.zeros(density.size, np.int32)
    for rows, cells in zip(tree.levels[:0:-1], tree.parent_cells[:0:-1], strict=True):
        filled = holds[rows]
        link[cells[filled]] = rows[filled]
        holds[cells[filled] // tree.N**3] = True
    return Source(tree.N, tree.N ** np.arange(1, len(tree.levels) + 1), link, density)
