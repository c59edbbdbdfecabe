"""Octree -> the same octree at a coarser level of detail."""

from __future__ import annotations

from dataclasses import replace

from nerfbake.errors import InvalidScene, Problem
from nerfbake.scene.octree import SparseVoxelOctree


def cut_octree(octree: SparseVoxelOctree, *, level: int) -> SparseVoxelOctree:
    """The octree down to a level: nodes of that level become leaves and show what they held for it.

    level: 0 (the root alone) to the level of single voxels. The grid is coarsened with it, a voxel to each cube of
    that level, in place in the world. In both layouts what remains is the start of what was there; nothing is
    computed. Source: TR-24-01 (docs/sources.md), 5.1.

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
