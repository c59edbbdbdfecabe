"""What every octree format shares: spelling "no child", and other writers' node orders."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from nerfbake.errors import InvalidFile, Problem
from nerfbake.scene.octree import SparseVoxelOctree


def children_with(children: npt.NDArray[np.int32], no_child: int) -> npt.NDArray[np.int32]:
    """The children table with 0 (as it is in memory) or -1 for "no child"."""
    return children if no_child == 0 else np.where(children == 0, np.int32(no_child), children)


def assemble(
    *,
    size: tuple[int, int, int],
    children: npt.NDArray[Any],
    data: npt.NDArray[Any],
    data_format: str,
    origin: npt.NDArray[Any],
    voxel_size: npt.NDArray[Any],
    extra_data: npt.NDArray[np.float32] | None,
) -> SparseVoxelOctree:
    """An octree from a file's arrays: -1 read as 0, nodes in another order sorted breadth-first.

    children (c, 8) integers. What cannot be right is left as it is: the scene reports it when asked.
    """
    if children.dtype != np.int32:
        if children.size and (abs(int(children.max())) > 2**31 - 1 or abs(int(children.min())) > 2**31 - 1):
            raise InvalidFile(Problem("node_children", "holds numbers beyond 32 bits", "-1 to 2147483647"))
        children = children.astype(np.int32)
    if children.size and (children == -1).any():
        children = np.where(children == -1, np.int32(0), children)
    octree = SparseVoxelOctree(size, children, data, data_format, origin, voxel_size, extra_data)
    return octree.breadth_first()
