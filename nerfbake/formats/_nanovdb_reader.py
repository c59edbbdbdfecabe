"""A NanoVDB file from anywhere: every count and offset is held to what a breadth-first tree must have.

The root's tiles may stand in any order: NanoVDB looks for them one by one (its binary search is switched off), and
nanovdb_convert leaves them in OpenVDB's, by signed coordinates. We write them sorted by key, which any search finds.
"""

from __future__ import annotations

import zlib
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake import memory
from nerfbake.errors import InvalidFile, Problem, one_line
from nerfbake.formats import _nanovdb_nodes as nano
from nerfbake.formats._deflate import inflate
from nerfbake.formats._vdb_frame import NAME, parse_frame
from nerfbake.kernels.bitmask import popcount, slots_of
from nerfbake.kernels.runs import rows_of_runs
from nerfbake.scene.vdb import IndexGrid, VdbTopology, VdbTree, root_keys
from nerfbake.scene.volume import OctreeFrame, Volume

Nodes = npt.NDArray[Any]


def read_file(view: memoryview) -> Volume:
    """The volume of the file's one grid. Raises InvalidFile, MemoryLimit."""
    file = _structs(view, 0, nano.FILE, 1, "the file's header")[0]
    if int(file["magic"]) != nano.MAGIC:
        found = f"starts with {one_line(bytes(view[:8]).decode('latin-1'))!r}"
        raise InvalidFile(Problem("the file", found, "'NanoVDB0', as versions 32.4 to 32.6 do"))
    if int(file["grids"]) != 1:
        raise InvalidFile(Problem("the file", f"holds {file['grids']} grids", "one"))
    at = nano.FILE.itemsize
    meta = _structs(view, at, nano.META, 1, "the grid's metadata")[0]
    at += nano.META.itemsize + int(meta["name_size"])
    size, stored = int(meta["grid_size"]), int(meta["file_size"])
    payload = view[at : at + stored]
    if len(payload) < stored:
        raise InvalidFile(Problem("the grid", f"ends after {len(payload):,} bytes", f"{stored:,} as its metadata says"))
    codec = int(meta["codec"])
    if codec not in nano.CODECS.values():
        raise InvalidFile(Problem("the grid", f"has codec {codec}", "0 (none), 1 (zip) or 2 (blosc)"))
    if codec != nano.CODECS["none"]:
        memory.hold("the grid", size)
        zipped = codec == nano.CODECS["zip"]
        payload = memoryview(inflate(payload[8:], size, "the grid") if zipped else _unblosced(payload, size))
    if len(payload) != size:
        raise InvalidFile(Problem("the grid", f"has {len(payload):,} bytes", f"{size:,} as its metadata says"))
    return _read_grid(payload)


def _unblosced(payload: memoryview, size: int) -> bytes:
    """The grid from buffers of at most 1 GiB each: u64 size | blosc buffer."""
    from nerfbake.formats._blosc import unblosc  # only files of other programs need it

    parts, at = [], 0
    for start in range(0, size, nano.BLOSC_CHUNK):
        stored = int(_structs(payload, at, np.dtype("<u8"), 1, "a blosc buffer's size")[0])
        buffer = payload[at + 8 : at + 8 + stored]
        parts.append(unblosc(buffer, min(nano.BLOSC_CHUNK, size - start), "the grid"))
        at += 8 + stored
    return b"".join(parts)


class _Tree(NamedTuple):
    layout: nano.Layout
    topology: VdbTopology
    order: npt.NDArray[np.int64]  # the stored leaf that each of the topology's is
    leaf: Nodes
    background: npt.NDArray[np.float32]


def _read_grid(view: memoryview) -> Volume:
    head = _structs(view, 0, nano.GRID, 1, "GridData")[0]
    layout = nano.LAYOUTS.get(int(head["type"]))
    if int(head["magic"]) != nano.MAGIC or layout is None:
        kinds = ", ".join(f"{number} ({layout.name})" for number, layout in nano.LAYOUTS.items())
        raise InvalidFile(Problem("GridData", f"has grid type {head['type']}", kinds))
    if int(head["size"]) != len(view):
        raise InvalidFile(Problem("GridData", f"has size {head['size']:,}", f"{len(view):,}, the grid's own"))
    tree = _read_tree(view, layout)
    checksum = _verify(view, head, layout)
    name = _text(head["name"])
    transform = np.concatenate([head["mat"], head["vec"][:, None]], axis=1).astype(np.float64)
    frame = None
    grid: VdbTree | IndexGrid
    if layout is nano.ON_INDEX:
        table, frame = _read_blind(view, head, tree.topology.m)
        if (np.diff(tree.order) < 0).any():
            rows = rows_of_runs(popcount(tree.leaf["mask"]), tree.order)
            table = table[np.append(0, 1 + rows)]
        grid = IndexGrid(name, tree.topology, table)
    else:
        grid = VdbTree(name, tree.topology, _values(tree), tree.background)
    return Volume((grid,), transform, frame, checksum)


def _verify(view: memoryview, head: Any, layout: nano.Layout) -> str:
    """What kind of checksum there is; its first part is verified. Raises InvalidFile if it is wrong."""
    first, second = map(int, head["crc"])
    if first == second == nano.HALF_CHECKSUM:
        return "none"
    tree = _structs(view, nano.GRID.itemsize, nano.TREE, 1, "TreeData")[0]
    # nanovdb_convert says 0 where there are no upper nodes.
    end = nano.GRID.itemsize + int(tree["offsets"][2] or tree["offsets"][3] + layout.root.itemsize)
    found = zlib.crc32(view[16:end])
    if found != first:
        raise InvalidFile(Problem("the checksum", f"is {first:08x}", f"{found:08x}, the CRC-32 of what stands there"))
    return "half" if second == nano.HALF_CHECKSUM else "full"


def _read_tree(view: memoryview, layout: nano.Layout) -> _Tree:
    base = nano.GRID.itemsize
    tree = _structs(view, base, nano.TREE, 1, "TreeData")[0]
    leaf_at, lower_at, upper_at, root_at = (base + int(offset) for offset in tree["offsets"])
    leaves, lowers, uppers = map(int, tree["counts"])
    root = _structs(view, root_at, layout.root, 1, "the root")[0]
    tiles = _structs(view, root_at + layout.root.itemsize, layout.tile, int(root["tiles"]), "the root's tiles")
    upper = _structs(view, upper_at, layout.upper, uppers, "upper nodes")
    lower = _structs(view, lower_at, layout.lower, lowers, "lower nodes")
    leaf = _structs(view, leaf_at, layout.leaf, leaves, "leaves")
    origin = _origins(tiles["key"])
    if len(tiles) != uppers or (root_keys(origin).astype(np.uint64) != tiles["key"]).any():
        raise InvalidFile(Problem("the root", f"has {len(tiles):,} tiles", f"{uppers:,}, one for each upper node"))
    for nodes, what in ((upper, "upper nodes"), (lower, "lower nodes")):
        if nodes["tiles"].any():
            raise InvalidFile(Problem(what, "have active tiles", "active voxels only"))
    masks = map(np.ascontiguousarray, (upper["children"], lower["children"], leaf["mask"]))
    stored = VdbTopology(origin, *masks)
    for problem in stored.mask_problems():
        raise InvalidFile(problem)
    topology, order = stored.in_order()
    for problem in topology.structure_problems():
        raise InvalidFile(problem)
    if int(tree["voxels"]) != stored.m:
        raise InvalidFile(Problem("TreeData", f"counts {tree['voxels']:,} voxels", f"{stored.m:,}, the leaves' bits"))
    if (tiles["child"] + root_at != upper_at + np.arange(uppers) * layout.upper.itemsize).any():
        raise InvalidFile(Problem("the root", "has tiles out of order", "children one after the other"))
    _require_links(upper, stored.upper_mask, upper_at, lower_at, lower.dtype.itemsize, "upper")
    _require_links(lower, stored.lower_mask, lower_at, leaf_at, leaf.dtype.itemsize, "lower")
    wrong = ((leaf["low"] & ~7) != stored.leaf_origin).any(axis=1) & stored.leaf_mask.any(axis=1)
    if wrong.any():
        first = int(np.argmax(wrong))
        found, right = leaf["low"][first].tolist(), stored.leaf_origin[first].tolist()
        raise InvalidFile(Problem(f"leaf {first}", f"lies at {found}", f"{right} and the 7 voxels on"))
    background = np.atleast_1d(root["background"]).astype(np.float32)
    if layout is nano.ON_INDEX and (leaf["first"] != stored.first + 1).any():
        raise InvalidFile(Problem("the leaves", "number their voxels otherwise", "from 1 on, leaf after leaf"))
    return _Tree(layout, topology, order, leaf, background)


def _require_links(nodes: Nodes, masks: Nodes, start: int, children: int, size: int, what: str) -> None:
    """Raises InvalidFile unless the nodes' children stand one after the other, in the order of the masks' bits."""
    row, slot = slots_of(masks)
    offset = children + np.arange(len(row)) * size - (start + row * nodes.dtype.itemsize)
    wrong = nodes["table"][row, slot, 0] != offset
    if wrong.any():
        first = int(np.argmax(wrong))
        found = f"points {int(nodes['table'][row[first], slot[first], 0]):,} bytes on"
        raise InvalidFile(Problem(f"{what}[{row[first]}].child[{slot[first]}]", found, f"{int(offset[first]):,}"))


def _origins(keys: npt.NDArray[np.uint64]) -> npt.NDArray[np.int32]:
    """(u, 3) the lowest voxels of root tiles."""
    numbers = np.stack([keys >> np.uint64(42), keys >> np.uint64(21), keys], axis=1).astype(np.int64) & 0xFFFFF
    return (((numbers + (1 << 19)) % (1 << 20) - (1 << 19)) * 4096).astype(np.int32)


def _values(tree: _Tree) -> npt.NDArray[np.float32]:
    """(m, c) the active voxels'."""
    row, slot = slots_of(tree.topology.leaf_mask)
    row = tree.order[row]
    values = tree.leaf["values"][row, slot]
    if tree.layout is nano.FP16:
        least, quantum = (tree.leaf[name][row] for name in ("least", "quantum"))
        values = (least + quantum * values.astype(np.float32))[:, None]
    return np.ascontiguousarray(values, np.float32)


# -- index grids -----------------------------------------------------------------------------------------------
def _read_blind(view: memoryview, head: Any, m: int) -> tuple[npt.NDArray[Any], OctreeFrame | None]:
    """The table and, if there is one, the frame."""
    start, count = int(head["blind_offset"]), int(head["blind"])
    structs = _structs(view, start, nano.BLIND, count, "blind data")
    table, frame = None, None
    for i, struct in enumerate(structs[:16]):
        at = start + i * nano.BLIND.itemsize + int(struct["offset"])
        name, number = _text(struct["name"]), int(struct["type"])
        if name == NAME:
            frame = parse_frame(_structs(view, at, np.dtype("u1"), int(struct["count"]), NAME).tobytes())
        elif table is None and int(struct["blind_class"]) == nano.CHANNEL_BLIND:
            dtype = {number: np.dtype(name) for name, number in nano.TABLE_TYPES.items()}.get(number)
            channels, rest = divmod(int(struct["count"]), m + 1)
            if dtype is None or rest or not channels:
                found = f"has {struct['count']:,} values of type {number} for {m:,} voxels"
                raise InvalidFile(Problem(f"blind data {name!r}", found, "float or half, as many for each row"))
            table = _structs(view, at, dtype, channels * (m + 1), name).reshape(m + 1, channels)
    if table is None:
        raise InvalidFile(Problem("the grid", f"has {count} blind data, none a table", "M_vdb, a channel array"))
    return table, frame


def _structs(view: memoryview, start: int, dtype: np.dtype[Any], count: int, what: str) -> Nodes:
    """(count,) of a dtype, a view. Raises InvalidFile unless all of it is there."""
    end = start + count * dtype.itemsize
    if start < 0 or end > len(view):
        raise InvalidFile(Problem(what, f"would stand at bytes {start:,} to {end:,}", f"0 to {len(view):,}"))
    return np.frombuffer(view[start:end], dtype)


def _text(raw: bytes) -> str:
    return one_line(bytes(raw).decode("utf-8", "replace"))
