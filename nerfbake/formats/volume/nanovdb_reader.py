"""Read NanoVDB files of any program: segments of grids, one after the other, or grids alone (since version 32.6).

Every count and offset is checked against the values of a breadth-first tree.

The root's tiles may be in any order: NanoVDB searches them linearly (its binary search is disabled), and
nanovdb_convert leaves them in OpenVDB's order, by signed coordinates. nerfbake writes them sorted by key, which both
kinds of search can find.
"""

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
from nerfbake.formats.wire import nanovdb as nano
from nerfbake.formats.wire.deflate import inflate
from nerfbake.formats.wire.nanovdb import LeafCodes, ValueBudget, root_tiles_of, tiles_of, voxels_of
from nerfbake.kernels.arrays import Bits, Ints
from nerfbake.kernels.maths.elementary import cast
from nerfbake.kernels.parallel import over_chunks
from nerfbake.kernels.vdb.bitmask import root_keys, slots_of
from nerfbake.scene.vdb import GRID_CLASSES, GridClass, IndexGrid, VdbTree
from nerfbake.scene.vdb_topology import VdbTiles, VdbTopology
from nerfbake.scene.volume import OctreeFrame, Volume

_CHUNK = 1 << 12  # leaf headers copied at a time
Nodes = npt.NDArray[Any]


class NanoVdbGrid(NamedTuple):
    """A grid without its name and transform; the fields are those of scene.vdb.VdbTree.

    rows: position in the file of each value, None if the values are already in order. An index grid has no values.
    """

    topology: VdbTopology
    rows: Ints | None
    values: npt.NDArray[np.float32]
    background: npt.NDArray[np.float32]
    active: Bits


def read_tree(view: memoryview, layout: nano.Layout, *, signed: bool) -> NanoVdbGrid:
    """Read the tree of one grid.

    signed: inactive quantised values may represent minus the background. Raises InvalidFile, MemoryLimit.
    """
    base = nano.GRID.itemsize
    tree = structs(view, base, nano.TREE, 1, "TreeData")[0]
    leaf_at, lower_at, upper_at, root_at = (base + int(offset) for offset in tree["offsets"])
    leaves, lowers, uppers = map(int, tree["counts"])
    root = structs(view, root_at, layout.root, 1, "the root")[0]
    entries = structs(view, root_at + layout.root.itemsize, layout.tile, int(root["tiles"]), "the root's tiles")
    upper = structs(view, upper_at, layout.upper, uppers, "upper nodes")
    lower = structs(view, lower_at, layout.lower, lowers, "lower nodes")
    origin, is_node = _origins(entries["key"]), entries["child"] != 0
    nodes = int(np.count_nonzero(is_node))
    if nodes != uppers or (root_keys(origin).astype(np.uint64) != entries["key"]).any():
        raise InvalidFile(
            Problem("the root", f"has {nodes:,} tiles with nodes", f"{uppers:,}, one for each upper node")
        )
    if (entries["child"][is_node] + root_at != upper_at + np.arange(uppers) * layout.upper.itemsize).any():
        raise InvalidFile(Problem("the root", "has tiles out of order", "children in consecutive order"))
    leaf, codes = _leaves(view, layout, leaf_at, leaves, lower, lower_at)
    masks = (np.ascontiguousarray(each) for each in (upper["children"], lower["children"], leaf["mask"]))
    upper_mask, lower_mask, leaf_mask = masks
    own = VdbTopology(origin[is_node], upper_mask, lower_mask, leaf_mask)
    for problem in own.mask_problems():
        raise InvalidFile(problem)
    _require_links(upper, own.upper_mask, upper_at, lower_at + np.arange(lowers) * layout.lower.itemsize, "upper")
    _require_links(lower, own.lower_mask, lower_at, codes.at, "lower")
    _require_places(leaf, own)
    background = cast(np.atleast_1d(root["background"]), np.float32)
    if layout is nano.ON_INDEX:
        return _index(own, leaf, int(tree["voxels"]), upper, lower, entries, is_node)
    room = ValueBudget(memory.left())
    tiles = [tiles_of(each, layout, background, room) for each in (lower, upper)]
    in_root = root_tiles_of(entries[~is_node], background)
    held = voxels_of(view, leaf, codes, layout, background, room, signed=signed)
    outer = VdbTiles(tiles[0].mask, tiles[1].mask, origin[~is_node][in_root.mask.astype(bool)])
    stored = VdbTopology(own.root_origin, upper_mask, lower_mask, held.mask, outer)
    parts = [held, *tiles, in_root]
    values, active = (np.concatenate([getattr(part, name) for part in parts]) for name in ("values", "active"))
    if int(tree["voxels"]) != (voxels := stored.only(active).voxel_count):
        raise InvalidFile(Problem("TreeData", f"counts {tree['voxels']:,} voxels", f"{voxels:,}, the masks' bits"))
    memory.hold("the grid", values.nbytes)
    topology, rows = _sorted(stored)
    if rows is not None:
        values, active = values[rows], active[rows]
    return NanoVdbGrid(topology, rows, values, background, active)


def structs(view: memoryview, start: int, dtype: np.dtype[Any], count: int, what: str) -> Nodes:
    """Return `count` structs of a dtype as a view, (count,). Raises InvalidFile if they extend beyond the file."""
    end = start + count * dtype.itemsize
    if start < 0 or end > len(view):
        raise InvalidFile(Problem(what, f"would be at bytes {start:,} to {end:,}", f"0 to {len(view):,}"))
    return np.frombuffer(view[start:end], dtype)


def _sorted(stored: VdbTopology) -> tuple[VdbTopology, Ints | None]:
    topology, rows = stored.in_order()
    for problem in topology.structure_problems():
        raise InvalidFile(problem)
    return topology, rows


def _index(
    own: VdbTopology, leaf: Nodes, voxels: int, upper: Nodes, lower: Nodes, entries: Nodes, is_node: Bits
) -> NanoVdbGrid:
    if upper["tiles"].any() or lower["tiles"].any() or entries["state"][~is_node].any():
        raise InvalidFile(Problem("the index", "has active tiles", "an index of voxels"))
    if voxels != own.m:
        raise InvalidFile(Problem("TreeData", f"counts {voxels:,} voxels", f"{own.m:,}, the leaves' bits"))
    if (leaf["first"] != own.first + 1).any():
        raise InvalidFile(Problem("the leaves", "do not number their voxels in order", "from 1, leaf by leaf"))
    nothing = np.zeros((0, 1), np.float32)
    return NanoVdbGrid(*_sorted(own), nothing, nothing[:, 0], np.zeros(0, bool))


# -- nodes -----------------------------------------------------------------------------------------------------
def _leaves(
    view: memoryview, layout: nano.Layout, start: int, count: int, lower: Nodes, lower_at: int
) -> tuple[Nodes, LeafCodes]:
    size = layout.leaf.itemsize
    if layout is not nano.FPN:
        leaf = structs(view, start, layout.leaf, count, "leaves")
        return leaf, LeafCodes(start + np.arange(count) * size, np.zeros(count, np.int64))
    # FpN leaves have variable lengths; the start of each leaf follows from the offset in its parent node.
    row, slot = slots_of(lower["children"])
    at = lower_at + row * lower.dtype.itemsize + lower["table"][row, slot, 0]
    if len(at) != count or (at < 0).any() or (at + size > len(view)).any():
        raise InvalidFile(Problem("the leaves", f"are {len(at):,}, or beyond the grid", f"{count:,} within it"))
    octets, heads = np.frombuffer(view, np.uint8), np.empty((count, size), np.uint8)

    def copy(begin: int, end: int) -> None:
        heads[begin:end] = octets[at[begin:end, None] + np.arange(size)]

    over_chunks(copy, count, _CHUNK)
    leaf = heads.reshape(-1).view(layout.leaf)
    bits = 1 << (leaf["flags"] >> 5).astype(np.int64)
    ends = at + size + 64 * bits
    if (bits > 16).any() or (at[1:] != ends[:-1]).any() or (count and (at[0] != start or ends[-1] > len(view))):
        raise InvalidFile(Problem("the leaves", "do not follow each other", "codes of 1, 2, 4, 8 or 16 bits"))
    return leaf, LeafCodes(at, bits)


def _require_links(nodes: Nodes, masks: Nodes, start: int, children: Ints, what: str) -> None:
    """Raise InvalidFile unless the nodes point to these children in the order of the mask bits."""
    row, slot = slots_of(masks)
    offset = children - (start + row * nodes.dtype.itemsize)
    wrong = nodes["table"][row, slot, 0] != offset
    if wrong.any():
        first = int(np.argmax(wrong))
        found = f"has offset {int(nodes['table'][row[first], slot[first], 0]):,}"
        raise InvalidFile(Problem(f"{what}[{row[first]}].child[{slot[first]}]", found, f"{int(offset[first]):,}"))


def _require_places(leaf: Nodes, own: VdbTopology) -> None:
    wrong = ((leaf["low"] & ~7) != own.leaf_origin).any(axis=1) & own.leaf_mask.any(axis=1)
    if wrong.any():
        first = int(np.argmax(wrong))
        found, right = leaf["low"][first].tolist(), own.leaf_origin[first].tolist()
        raise InvalidFile(Problem(f"leaf {first}", f"lies at {found}", f"{right} to 7 voxels further"))


def _origins(keys: npt.NDArray[np.uint64]) -> npt.NDArray[np.int32]:
    """Return the lowest voxels of root tiles, (u, 3)."""
    numbers = np.stack([keys >> np.uint64(42), keys >> np.uint64(21), keys], axis=1).astype(np.int64) & 0xFFFFF
    return (((numbers + (1 << 19)) % (1 << 20) - (1 << 19)) * 4096).astype(np.int32)


MAX_GRIDS = 1000
_HALVES = {nano.DOUBLE.name: "double", nano.FP4.name: "Fp4", nano.FP8.name: "Fp8", nano.FPN.name: "FpN"}
_CLASSES: dict[int, GridClass] = {nano.CLASSES[name]: name for name in GRID_CLASSES}


class _Grid(NamedTuple):
    tree: VdbTree | IndexGrid
    transform: npt.NDArray[np.float64]
    frame: OctreeFrame | None
    checksum: str


def read_file(view: memoryview) -> Volume:
    """Read all grids of a file as a volume. Raises InvalidFile, MemoryLimit."""
    read: list[_Grid] = []
    unread: list[Problem] = []
    raw = bytes(view[:8]) == nano.GRID_MAGIC.to_bytes(8, "little")
    for name, data in _raw_grids(view) if raw else _segments(view):
        grid = _read_grid(data, name)
        if isinstance(grid, Problem):
            unread.append(grid)
            continue
        read.append(grid)
    if not read:
        raise InvalidFile(unread[0] if unread else Problem("the file", "is empty", "one grid or more"))
    first = read[0].transform
    grids = []
    for tree, transform, *_ in read:
        own = transform.tobytes() != first.tobytes()
        if own and isinstance(tree, IndexGrid):
            raise InvalidFile(
                Problem(
                    f"grid {tree.name!r}", "is an index grid with another transform", "the transform of the first grid"
                )
            )
        grids.append(replace(tree, place=transform) if own and isinstance(tree, VdbTree) else tree)
    frame = next((grid.frame for grid in read if grid.frame), None)
    return Volume(tuple(grids), first, frame, read[0].checksum, tuple(unread))


# -- the file --------------------------------------------------------------------------------------------------
def _raw_grids(view: memoryview) -> Iterator[tuple[str, memoryview]]:
    """Yield the name and the bytes of each grid of a file without headers: grids, one after the other."""
    at = count = 0
    while at < len(view):
        head = structs(view, at, nano.GRID, 1, "GridData")[0]
        size, count = int(head["size"]), count + 1
        if size < nano.GRID.itemsize or count > MAX_GRIDS:
            raise InvalidFile(Problem("GridData", f"of grid {count:,} has size {size:,}", f"{MAX_GRIDS:,} whole grids"))
        yield _text(head["name"]), view[at : at + size]
        at += size


def _segments(view: memoryview) -> Iterator[tuple[str, memoryview]]:
    """Yield the name and the bytes of each grid."""
    at = count = 0
    while at < len(view):
        file = structs(view, at, nano.FILE, 1, "the file's header" if not at else "the data after the grids")[0]
        if int(file["magic"]) not in (nano.MAGIC, nano.FILE_MAGIC):
            found = f"starts with {one_line(bytes(view[at : at + 8]).decode('latin-1'))!r}"
            place = "the data after the grids" if at else "the file"
            raise InvalidFile(Problem(place, found, "'NanoVDB0', or 'NanoVDB2' since version 32.7"))
        _require_version(int(file["version"]), "the file")
        count += int(file["grids"])
        if not int(file["grids"]) or count > MAX_GRIDS:
            raise InvalidFile(Problem("the file", f"contains {count:,} grids", f"1 to {MAX_GRIDS:,}"))
        at += nano.FILE.itemsize
        metas = []
        for _ in range(int(file["grids"])):
            meta = structs(view, at, nano.META, 1, "the grid's metadata")[0]
            at += nano.META.itemsize + int(meta["name_size"])
            metas.append((meta, _text(view[at - int(meta["name_size"]) : at])))
        for meta, name in metas:
            stored = int(meta["file_size"])
            # Warp does not count the size before a compressed grid.
            if int(meta["codec"]) and at + 8 <= len(view) and int.from_bytes(view[at : at + 8], "little") == stored:
                stored += 8
            payload = view[at : at + stored]
            if len(payload) < stored:
                found = f"ends after {len(payload):,} bytes"
                raise InvalidFile(Problem("the grid", found, f"{stored:,}, the size in its metadata"))
            at += stored
            yield name, _unpacked(meta, payload)


def _unpacked(meta: Any, payload: memoryview) -> memoryview:
    """Decompress the stored bytes of a grid."""
    codec, size = int(meta["codec"]), int(meta["grid_size"])
    if codec not in nano.CODECS.values():
        raise InvalidFile(Problem("the grid", f"has codec {codec}", "0 (none), 1 (zip) or 2 (blosc)"))
    if codec != nano.CODECS["none"]:
        memory.hold("the grid", size)
        zipped = codec == nano.CODECS["zip"]
        payload = memoryview(inflate(payload[8:], size, "the grid") if zipped else _unblosced(payload, size))
    if len(payload) != size:
        raise InvalidFile(Problem("the grid", f"has {len(payload):,} bytes", f"{size:,}, the size in its metadata"))
    return payload


def _unblosced(payload: memoryview, size: int) -> bytes:
    """Decompress a grid from blosc buffers of at most 1 GiB each: u64 size | blosc buffer."""
    from nerfbake.formats.wire.blosc import unblosc  # imported here: only files of other programs use blosc

    parts, at = [], 0
    for start in range(0, size, nano.BLOSC_CHUNK):
        stored = int(structs(payload, at, np.dtype("<u8"), 1, "a blosc buffer's size")[0])
        buffer = payload[at + 8 : at + 8 + stored]
        parts.append(unblosc(buffer, min(nano.BLOSC_CHUNK, size - start), "the grid"))
        at += 8 + stored
    return b"".join(parts)


def _require_version(version: int, place: str) -> None:
    """Raise InvalidFile for another major version, whose structs may differ."""
    major, minor = version >> 21, version >> 10 & 1023
    if major != nano.MAJOR:
        raise InvalidFile(Problem(place, f"has version {major}.{minor}", f"{nano.MAJOR}, the major version"))


# -- a grid ----------------------------------------------------------------------------------------------------
def _read_grid(view: memoryview, name: str) -> _Grid | Problem:
    """Return the grid, or the problem if its type is not supported."""
    head = structs(view, 0, nano.GRID, 1, "GridData")[0]
    if int(head["magic"]) not in (nano.MAGIC, nano.GRID_MAGIC):
        found, allowed = f"has magic {int(head['magic']):016x}", f"{nano.MAGIC:016x} or {nano.GRID_MAGIC:016x}"
        raise InvalidFile(Problem("GridData", found, allowed))
    _require_version(int(head["version"]), "GridData")
    if unknown := int(head["flags"]) & ~nano.KNOWN_FLAGS:
        raise InvalidFile(Problem("GridData", f"has flags 0x{unknown:x}", f"0x{nano.KNOWN_FLAGS:x}"))
    if not int(head["flags"]) & nano.FLAG_LONG_NAME:
        name = _text(head["name"])
    number = int(head["type"])
    layout = nano.LAYOUTS.get(number)
    if layout is None:
        found = f"has values of type {nano.OTHERS.get(number, number)}"
        return Problem(f"grid {name[:80]!r}", found, ", ".join(known.name for known in nano.LAYOUTS.values()))
    if int(head["size"]) != len(view):
        raise InvalidFile(Problem("GridData", f"has size {head['size']:,}", f"{len(view):,}, the size of the grid"))
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
    """Verify the first part of the checksum and return its kind. Raises InvalidFile if the checksum is wrong."""
    first, second = map(int, head["crc"])
    if first == second == nano.HALF_CHECKSUM:
        return "none"
    if int(head["version"]) > nano.LAST_LONG_CHECKSUM:
        end = nano.GRID.itemsize + nano.TREE.itemsize
    else:
        tree = structs(view, nano.GRID.itemsize, nano.TREE, 1, "TreeData")[0]
        # nanovdb_convert writes 0 if there are no upper nodes.
        end = nano.GRID.itemsize + int(tree["offsets"][2] or tree["offsets"][3] + layout.root.itemsize)
    found = zlib.crc32(view[16:end])
    if found != first:
        raise InvalidFile(Problem("the checksum", f"is {first:08x}", f"{found:08x}, the CRC-32 of the data"))
    return "half" if second == nano.HALF_CHECKSUM else "full"


def _read_blind(view: memoryview, head: Any, m: int) -> tuple[npt.NDArray[Any], OctreeFrame | None]:
    """Read the table of an index grid, and the frame if there is one."""
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
                raise InvalidFile(Problem(f"blind data {name!r}", found, "float or half, the same number for each row"))
            table = structs(view, at, dtype, channels * (m + 1), name).reshape(m + 1, channels)
    if table is None:
        raise InvalidFile(
            Problem("the grid", f"has {count} blind data sections, none of them a table", "M_vdb, a channel array")
        )
    return table, frame


def _text(raw: Any) -> str:
    return one_line(bytes(raw).partition(b"\0")[0].decode("utf-8", "replace"))
