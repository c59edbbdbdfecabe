"""Read and write octrees as NumPy archives (.svo.npz), which scripts can read with `np.load` alone.

| key | dtype, shape | meaning |
|---|---|---|
| svo_version | int64 | 1 |
| size | int32 (3,) | W, H, D |
| node_children | int32 (c, 8) | c = n (`full`) or the nodes above the last level (`compact`) |
| node_data | float32 or float16 (n, D) | sigma last |
| level_sizes | int32 (levels,) | nodes of each level |
| data_format | text | 'SH9', ... |
| origin, voxel_size | float64 (3,) | world = origin + voxel * voxel_size |
| extra_data | float32 (B, 4 or 11) | only for SG and ASG |
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import numpy.typing as npt

from nerfbake.errors import InvalidFile, Problem
from nerfbake.formats.octree.fields import NoChild, assemble, children_with
from nerfbake.formats.wire.npz import NpzReader, StreamedArray, write_npz
from nerfbake.formats.wire.zip_reader import npz_keys
from nerfbake.scene.octree import SparseVoxelOctree

VERSION = 1


def recognise(view: memoryview) -> bool:
    """True for an archive with the member svo_version."""
    return "svo_version" in npz_keys(view)


def encode(octree: SparseVoxelOctree, *, no_child: NoChild = 0) -> Iterator[bytes | memoryview]:
    arrays: dict[str, npt.ArrayLike | StreamedArray] = {
        "svo_version": np.int64(VERSION),
        "size": np.array(octree.size, np.int32),
        "node_children": children_with(octree.node_children, no_child),
        "node_data": StreamedArray(octree.node_rows),
        "level_sizes": np.array(octree.level_sizes, np.int32),
        "data_format": np.array(octree.data_format),
        "origin": octree.origin,
        "voxel_size": octree.voxel_size,
    }
    if octree.extra_data is not None:
        arrays["extra_data"] = octree.extra_data
    return write_npz(arrays)


def decode(view: memoryview) -> SparseVoxelOctree:
    npz = NpzReader(view)
    npz.require("svo_version", "size", "node_children", "node_data", "data_format", "origin", "voxel_size")
    if (version := npz.scalar("svo_version")) != VERSION:
        raise InvalidFile(Problem("svo_version", f"is {version}", f"{VERSION}"))
    size = npz.shaped("size", "iu", (3,))
    return assemble(
        size=(int(size[0]), int(size[1]), int(size[2])),
        children=npz.shaped("node_children", "i", (None, 8)),
        data=npz.shaped("node_data", "f", (None, None)),
        data_format=str(npz.scalar("data_format")),
        origin=npz.shaped("origin", "f", (3,)),
        voxel_size=npz.shaped("voxel_size", "f", (3,)),
        extra_data=npz.single("extra_data") if "extra_data" in npz else None,
    )
