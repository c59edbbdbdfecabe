"""Read and write NanoVDB (.nvdb), one grid per file: density (Float, Fp16), colour (Vec3f), or an index with its table
(OnIndex).

    u64 'NanoVDB0' | u32 version | u16 grids = 1 | u16 codec        16 bytes
    metadata                                                        176 bytes
    name and NUL
    the grid's bytes (layout: nanovdb_writer.py); with codec zip: u64 size | one zlib stream of these bytes

The versions written are 32.4.2 for values and 32.6.0 for OnIndex, the newest that both old and new readers accept. The
checksum covers only the first part of the grid ("half"), because all readers verify this kind in the same way. Source:
docs/formats/vdb.md, "NanoVDB files".
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Literal

import numpy as np

from nerfbake import memory
from nerfbake.errors import InvalidScene, Problem, UsageError
from nerfbake.formats.volume.nanovdb_reader import read_file
from nerfbake.formats.volume.nanovdb_writer import LazyBytes, size_of, write_grid
from nerfbake.formats.wire import nanovdb as nano
from nerfbake.formats.wire.blob import row_pieces
from nerfbake.formats.wire.deflate import deflate_all
from nerfbake.scene.vdb import IndexGrid, VdbTree
from nerfbake.scene.volume import Volume

Codec = Literal["none", "zip"]
DEFAULT_GRIDS = ("density",)
FIELD_GRIDS = ("index",)
KEEPS_HALVES = False  # Fp16 stores codes between the minimum and maximum of a leaf
HALF_NOTE = "note: half densities in a .nvdb are Fp16, which Warp loads and then reads as zeros"


def recognise(view: memoryview) -> bool:
    """Return True for the first bytes of a NanoVDB file of any version."""
    return bytes(view[:7]) == b"NanoVDB"


def require_grids(grids: tuple[str, ...], *, half: bool) -> None:
    if len(grids) > 1 or "sh" in grids:
        raise UsageError(f"a .nvdb would contain the grids {','.join(grids)}; allowed: one of density, Cd, index")
    if half and "Cd" in grids:
        raise UsageError("a .nvdb has no half colours; allowed: no `half`, or another grid")


def encode(volume: Volume, *, codec: Codec = "none") -> Iterator[bytes | memoryview]:
    """Yield the file in chunks. Raises InvalidScene for more than one grid, because some readers ignore the second."""
    if len(volume.grids) != 1:
        raise InvalidScene(
            Problem(
                "a .nvdb",
                f"would contain {len(volume.grids)} grids: {', '.join(volume.labels)}",
                "`grid=NAME` for one of them, or `grid=all` for one file per grid",
            )
        )
    first = volume.grids[0]
    if codec == "zip" and isinstance(first, IndexGrid) and not isinstance(first.table_rows, np.ndarray):
        memory.require("the table, packed,", first.table_rows.nbytes)
    grid_pieces, grid, box = write_grid(volume)
    size = stored = sum(map(size_of, grid_pieces))
    pieces = _chunks(grid_pieces)
    if codec == "zip":
        packed = deflate_all(pieces)
        pieces, stored = iter([len(packed).to_bytes(8, "little"), packed]), 8 + len(packed)
    name = first.name.encode() + b"\0"
    file, meta = np.zeros(1, nano.FILE), np.zeros(1, nano.META)
    file["magic"], file["version"], file["grids"], file["codec"] = nano.MAGIC, grid["version"], 1, nano.CODECS[codec]
    for field in ("type", "grid_class", "world", "voxel", "version", "blind"):
        meta[field] = grid[field]
    meta["grid_size"], meta["file_size"], meta["box"] = size, stored, box
    meta["name_key"], meta["name_size"], meta["codec"] = _name_key(name[:-1]), len(name), nano.CODECS[codec]
    active = first.active_topology if isinstance(first, VdbTree) else first.topology
    meta["nodes"], meta["voxels"] = (*first.topology.node_counts[::-1], 1), active.voxel_count
    meta["tiles"] = active.tile_counts
    yield file.tobytes() + meta.tobytes() + name
    yield from pieces


def _chunks(pieces: list[bytes | memoryview | LazyBytes]) -> Iterator[bytes | memoryview]:
    for piece in pieces:
        if isinstance(piece, LazyBytes):
            yield from row_pieces(piece.rows)
        else:
            yield piece


def decode(view: memoryview) -> Volume:
    return read_file(view)


def _name_key(name: bytes) -> int:
    """Return NanoVDB's hash of a grid name."""
    key = 0
    for char in name:
        key = (key * 67 + char + (key >> 56)) & 0xFFFFFFFFFFFFFFFF
    return key
