"""A NanoVDB file from anywhere: segments of grids, one behind the other; nanovdb_tree reads what a grid holds."""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake import memory
from nerfbake.errors import InvalidFile, Problem, one_line
from nerfbake.formats.volume.frame import NAME, parse_frame
from nerfbake.formats.volume.nanovdb_tree import read_tree, structs
from nerfbake.formats.wire import nanovdb_nodes as nano
from nerfbake.formats.wire.deflate import inflate
from nerfbake.scene.vdb import GRID_CLASSES, GridClass, IndexGrid, VdbTree
from nerfbake.scene.volume import OctreeFrame, Volume

MAX_GRIDS = 1000
_HALVES = {nano.DOUBLE.name: "double", nano.FP4.name: "Fp4", nano.FP8.name: "Fp8", nano.FPN.name: "FpN"}
_CLASSES: dict[int, GridClass] = {nano.CLASSES[name]: name for name in GRID_CLASSES}


class _Grid(NamedTuple):
    tree: VdbTree | IndexGrid
    transform: npt.NDArray[np.float64]
    frame: OctreeFrame | None
    checksum: str


def read_file(view: memoryview) -> Volume:
    """The volume of the file's grids. Raises InvalidFile, MemoryLimit."""
    read: list[_Grid] = []
    unread: list[Problem] = []
    for meta, name, payload in _segments(view):
        grid = _read_grid(_unpacked(meta, payload), name)
        if isinstance(grid, Problem):
            unread.append(grid)
            continue
        read.append(grid)
    if not read:
        raise InvalidFile(unread[0])
    first = read[0].transform
    grids = []
    for tree, transform, *_ in read:
        own = transform.tobytes() != first.tobytes()
        if own and isinstance(tree, IndexGrid):
            raise InvalidFile(
                Problem(f"grid {tree.name!r}", "is an index elsewhere", "the transform of the first grid")
            )
        grids.append(replace(tree, place=transform) if own and isinstance(tree, VdbTree) else tree)
    frame = next((grid.frame for grid in read if grid.frame), None)
    return Volume(tuple(grids), first, frame, read[0].checksum, tuple(unread))


# -- the file --------------------------------------------------------------------------------------------------
def _segments(view: memoryview) -> Iterator[tuple[Any, str, memoryview]]:
    """Of each grid its metadata, its name and its bytes as they are stored."""
    at = count = 0
    while at < len(view):
        file = structs(view, at, nano.FILE, 1, "the file's header" if not at else "what stands behind the grids")[0]
        if int(file["magic"]) != nano.MAGIC:
            found = f"starts with {one_line(bytes(view[at : at + 8]).decode('latin-1'))!r}"
            place = "what stands behind the grids" if at else "the file"
            raise InvalidFile(Problem(place, found, "'NanoVDB0', as versions 32.4 to 32.6 do"))
        count += int(file["grids"])
        if not int(file["grids"]) or count > MAX_GRIDS:
            raise InvalidFile(Problem("the file", f"holds {count:,} grids", f"1 to {MAX_GRIDS:,}"))
        at += nano.FILE.itemsize
        metas = []
        for _ in range(int(file["grids"])):
            meta = structs(view, at, nano.META, 1, "the grid's metadata")[0]
            at += nano.META.itemsize + int(meta["name_size"])
            metas.append((meta, _text(view[at - int(meta["name_size"]) : at])))
        for meta, name in metas:
            stored = int(meta["file_size"])
            payload = view[at : at + stored]
            if len(payload) < stored:
                found = f"ends after {len(payload):,} bytes"
                raise InvalidFile(Problem("the grid", found, f"{stored:,} as its metadata says"))
            at += stored
            yield meta, name, payload


def _unpacked(meta: Any, payload: memoryview) -> memoryview:
    """A grid's bytes from what is stored of them."""
    codec, size = int(meta["codec"]), int(meta["grid_size"])
    if codec not in nano.CODECS.values():
        raise InvalidFile(Problem("the grid", f"has codec {codec}", "0 (none), 1 (zip) or 2 (blosc)"))
    if codec != nano.CODECS["none"]:
        memory.hold("the grid", size)
        zipped = codec == nano.CODECS["zip"]
        payload = memoryview(inflate(payload[8:], size, "the grid") if zipped else _unblosced(payload, size))
    if len(payload) != size:
        raise InvalidFile(Problem("the grid", f"has {len(payload):,} bytes", f"{size:,} as its metadata says"))
    return payload


def _unblosced(payload: memoryview, size: int) -> bytes:
    """The grid from buffers of at most 1 GiB each: u64 size | blosc buffer."""
    from nerfbake.formats.wire.blosc import unblosc  # only files of other programs need it

    parts, at = [], 0
    for start in range(0, size, nano.BLOSC_CHUNK):
        stored = int(structs(payload, at, np.dtype("<u8"), 1, "a blosc buffer's size")[0])
        buffer = payload[at + 8 : at + 8 + stored]
        parts.append(unblosc(buffer, min(nano.BLOSC_CHUNK, size - start), "the grid"))
        at += 8 + stored
    return b"".join(parts)


# -- a grid ----------------------------------------------------------------------------------------------------
def _read_grid(view: memoryview, name: str) -> _Grid | Problem:
    """The grid, or why it is none that could be read."""
    head = structs(view, 0, nano.GRID, 1, "GridData")[0]
    if int(head["magic"]) != nano.MAGIC:
        raise InvalidFile(Problem("GridData", f"has magic {int(head['magic']):016x}", f"{nano.MAGIC:016x}"))
    if not int(head["flags"]) & nano.FLAG_LONG_NAME:
        name = _text(head["name"])
    number = int(head["type"])
    layout = nano.LAYOUTS.get(number)
    if layout is None:
        found = f"has values of type {nano.OTHERS.get(number, number)}"
        return Problem(f"grid {name[:80]!r}", found, ", ".join(known.name for known in nano.LAYOUTS.values()))
    if int(head["size"]) != len(view):
        raise InvalidFile(Problem("GridData", f"has size {head['size']:,}", f"{len(view):,}, the grid's own"))
    grid_class = _CLASSES.get(int(head["grid_class"]), "unknown")
    tree = read_tree(view, layout, signed=grid_class == "level set")
    checksum = _verify(view, head, layout)
    transform = np.concatenate([head["mat"], head["vec"][:, None]], axis=1).astype(np.float64)
    if layout is nano.ON_INDEX:
        table, frame = _read_blind(view, head, tree.topology.m)
        if tree.rows is not None:
            table = table[np.append(0, 1 + tree.rows)]
        return _Grid(IndexGrid(name, tree.topology, table), transform, frame, checksum)
    stored = _HALVES.get(layout.name, "")
    grid = VdbTree(name, tree.topology, tree.values, tree.background, grid_class, tree.active, stored=stored)
    return _Grid(grid, transform, None, checksum)


def _verify(view: memoryview, head: Any, layout: nano.Layout) -> str:
    """What kind of checksum there is; its first part is verified. Raises InvalidFile if it is wrong."""
    first, second = map(int, head["crc"])
    if first == second == nano.HALF_CHECKSUM:
        return "none"
    tree = structs(view, nano.GRID.itemsize, nano.TREE, 1, "TreeData")[0]
    # nanovdb_convert says 0 where there are no upper nodes.
    end = nano.GRID.itemsize + int(tree["offsets"][2] or tree["offsets"][3] + layout.root.itemsize)
    found = zlib.crc32(view[16:end])
    if found != first:
        raise InvalidFile(Problem("the checksum", f"is {first:08x}", f"{found:08x}, the CRC-32 of what stands there"))
    return "half" if second == nano.HALF_CHECKSUM else "full"


def _read_blind(view: memoryview, head: Any, m: int) -> tuple[npt.NDArray[Any], OctreeFrame | None]:
    """The table and, if there is one, the frame."""
    start, count = int(head["blind_offset"]), int(head["blind"])
    blind = structs(view, start, nano.BLIND, count, "blind data")
    table, frame = None, None
    for i, struct in enumerate(blind[:16]):
        at = start + i * nano.BLIND.itemsize + int(struct["offset"])
        name, number = _text(struct["name"]), int(struct["type"])
        if name == NAME:
            frame = parse_frame(structs(view, at, np.dtype("u1"), int(struct["count"]), name).tobytes())
        elif table is None and int(struct["blind_class"]) == nano.CHANNEL_BLIND:
            dtype = {number: np.dtype(name) for name, number in nano.TABLE_TYPES.items()}.get(number)
            channels, rest = divmod(int(struct["count"]), m + 1)
            if dtype is None or rest or not channels:
                found = f"has {struct['count']:,} values of type {number} for {m:,} voxels"
                raise InvalidFile(Problem(f"blind data {name!r}", found, "float or half, as many for each row"))
            table = structs(view, at, dtype, channels * (m + 1), name).reshape(m + 1, channels)
    if table is None:
        raise InvalidFile(Problem("the grid", f"has {count} blind data, none a table", "M_vdb, a channel array"))
    return table, frame


def _text(raw: Any) -> str:
    return one_line(bytes(raw).partition(b"\0")[0].decode("utf-8", "replace"))
