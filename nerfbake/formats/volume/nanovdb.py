"""NanoVDB (.nvdb), one grid a file: density (Float, Fp16), colour (Vec3f), or an index with its table (OnIndex).

    u64 'NanoVDB0' | u32 version | u16 grids = 1 | u16 codec        16 bytes
    metadata                                                        176 bytes
    name and NUL
    the grid's bytes (nanovdb_writer draws them), or with codec zip: u64 size | one zlib stream of them

Versions are 32.4.2 for values and 32.6.0 for OnIndex, the newest that both old and new readers take. The checksum is
of the first part of the grid only ("half"): that is what all of them verify alike. Source: docs/formats/vdb.md,
"NanoVDB files".
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Literal

import numpy as np

from nerfbake import memory
from nerfbake.errors import InvalidScene, Problem, UsageError
from nerfbake.formats.volume.nanovdb_reader import read_file
from nerfbake.formats.volume.nanovdb_writer import Later, size_of, write_grid
from nerfbake.formats.wire import nanovdb_nodes as nano
from nerfbake.formats.wire.blob import row_pieces
from nerfbake.formats.wire.deflate import deflate_all
from nerfbake.scene.vdb import IndexGrid, VdbTree
from nerfbake.scene.volume import Volume

Codec = Literal["none", "zip"]
DEFAULT_GRIDS = ("density",)
KEEPS_HALVES = False  # they are codes between the ends of a leaf
HALF_NOTE = "note: half densities in a .nvdb are Fp16, which Warp loads and then reads as zeros"


def recognise(view: memoryview) -> bool:
    """True for the first bytes of a NanoVDB file of any version."""
    return bytes(view[:7]) == b"NanoVDB"


def require_grids(grids: tuple[str, ...], *, half: bool) -> None:
    if len(grids) > 1 or "sh" in grids:
        raise UsageError(f"a .nvdb would hold the grids {','.join(grids)}; allowed: one of density, Cd, index")
    if half and "Cd" in grids:
        raise UsageError("a .nvdb has no half colours; allowed: no `half`, or another grid")


def encode(volume: Volume, *, codec: Codec = "none") -> Iterator[bytes | memoryview]:
    """The file in pieces. Raises InvalidScene for more than one grid: some readers lose the second."""
    if len(volume.grids) != 1:
        raise InvalidScene(
            Problem(
                "a .nvdb",
                f"would hold {len(volume.grids)} grids: {', '.join(volume.labels)}",
                "`grid=NAME` for one of them; all of them with `grid=all`, a file each",
            )
        )
    first = volume.grids[0]
    if codec == "zip" and isinstance(first, IndexGrid) and not isinstance(first.table_rows, np.ndarray):
        memory.require("the table, packed,", first.table_rows.nbytes)
    grid_pieces, grid, box = write_grid(volume)
    size = stored = sum(map(size_of, grid_pieces))
    pieces = _made(grid_pieces)
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


def _made(pieces: list[bytes | memoryview | Later]) -> Iterator[bytes | memoryview]:
    for piece in pieces:
        if isinstance(piece, Later):
            yield from row_pieces(piece.rows)
        else:
            yield piece


def decode(view: memoryview) -> Volume:
    return read_file(view)


def _name_key(name: bytes) -> int:
    """NanoVDB's hash of a grid's name."""
    key = 0
    for char in name:
        key = (key * 67 + char + (key >> 56)) & 0xFFFFFFFFFFFFFFFF
    return key
