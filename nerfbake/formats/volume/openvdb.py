"""Read and write OpenVDB (.vdb), file version 224: any number of grids of float, half, or three of them per voxel.

    i64 0x56444220 | u32 224 | u32 major | u32 minor | u8 1 | 36 characters UUID | metadata | i32 grids
    per grid: name | type | parent '' | i64 start, buffers, end | at start: see openvdb_writer.py

text = u32 length | bytes                       metadata = u32 entries | (name, type, u32 size, value) each

Each node stores only its active values, as a separate zlib stream. The UUID is zeros, so that the same grids give the
same bytes. Source: docs/formats/vdb.md, "OpenVDB files".
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Iterator
from typing import Literal

from nerfbake.errors import InvalidScene, Problem, UsageError
from nerfbake.formats.volume.openvdb_reader import read_file
from nerfbake.formats.volume.openvdb_writer import TYPES, write_grid
from nerfbake.formats.wire.openvdb import MAGIC, UUID, VERSION, text
from nerfbake.scene.vdb import IndexGrid, VdbTree
from nerfbake.scene.volume import OctreeFrame, Transform, Volume

LIBRARY = (10, 0)  # the OpenVDB version that files declare
DEFAULT_GRIDS = FIELD_GRIDS = ("density", "Cd")
KEEPS_HALVES = True
HALF_NOTE = None


def recognise(view: memoryview) -> bool:
    """Return True for the first bytes of an OpenVDB file of any version."""
    return bytes(view[:8]) == MAGIC.to_bytes(8, "little")


def require_grids(grids: tuple[str, ...], *, half: bool) -> None:
    if "index" in grids:
        raise UsageError("a .vdb has no index grids; allowed: density, Cd, sh, or a .nvdb or .vdb.npz")


def encode(volume: Volume, *, codec: Literal["none", "zip"] = "zip") -> Iterator[bytes | memoryview]:
    """Yield the file in chunks. Raises InvalidScene for an index grid, which the format does not support."""
    placed = ((_tree(grid), volume.transform_of(grid)) for grid in volume.grids)
    yield from file_of(placed, len(volume.grids), frame=volume.frame, zipped=codec == "zip")


def file_of(
    grids: Iterable[tuple[VdbTree, Transform]], count: int, *, frame: OctreeFrame | None = None, zipped: bool = True
) -> Iterator[bytes | memoryview]:
    """Yield a file of `count` grids with their transforms. `grids` may be a generator that creates them one by one."""
    yield struct.pack("<qIIIB", MAGIC, VERSION, *LIBRARY, 1) + UUID + struct.pack("<Ii", 0, count)
    at = 8 + 12 + 1 + len(UUID) + 8
    for k, (grid, transform) in enumerate(grids):
        # The frame is metadata of the first grid, because tools that copy grids keep the metadata of a grid.
        written = write_grid(grid, transform, frame if k == 0 else None, zipped=zipped)
        name = text(grid.name) + text(TYPES[grid.values.shape[1], grid.values.dtype.name]) + text("")
        start = at + len(name) + 24
        buffers = start + sum(map(len, written.front))
        at = buffers + sum(map(len, written.buffers))
        yield name + struct.pack("<3q", start, buffers, at)
        yield from written.front
        yield from written.buffers


def _tree(grid: VdbTree | IndexGrid) -> VdbTree:
    if isinstance(grid, IndexGrid):
        raise InvalidScene(Problem("a .vdb", "has no index grids", "density, Cd, sh, or a .nvdb"))
    return grid


def decode(view: memoryview) -> Volume:
    return read_file(view)
