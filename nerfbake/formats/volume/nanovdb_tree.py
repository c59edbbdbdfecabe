"""One tree of a NanoVDB file: every count and offset is held to what a breadth-first tree must have.

The root's tiles may stand in any order: NanoVDB looks for them one by one (its binary search is switched off), and
nanovdb_convert leaves them in OpenVDB's, by signed coordinates. We write them sorted by key, which any search finds.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake import memory
from nerfbake.errors import InvalidFile, Problem
from nerfbake.formats.wire import nanovdb_nodes as nano
from nerfbake.formats.wire.nanovdb_values import Codes, Room, root_tiles_of, tiles_of, voxels_of
from nerfbake.kernels.arrays import Bits, Ints
from nerfbake.kernels.maths.casting import cast
from nerfbake.kernels.parallel import over_chunks
from nerfbake.kernels.vdb.bitmask import slots_of
from nerfbake.kernels.vdb.slots import root_keys
from nerfbake.scene.vdb_tiles import VdbTiles
from nerfbake.scene.vdb_topology import VdbTopology

_CHUNK = 1 << 12  # leaves' heads at a time
Nodes = npt.NDArray[Any]


class Tree(NamedTuple):
    """A grid but for its name and its place: scene.vdb.VdbTree says what each field is. rows: the value in the file
    that each value here is, None where they are in order; an index has no values."""

    topology: VdbTopology
    rows: Ints | None
    values: npt.NDArray[np.float32]
    background: npt.NDArray[np.float32]
    active: Bits


def read_tree(view: memoryview, layout: nano.Layout, *, signed: bool) -> Tree:
    """Raises InvalidFile, MemoryLimit. signed: inactive quantised values may stand for minus the background."""
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
        raise InvalidFile(Problem("the root", "has tiles out of order", "children one after the other"))
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
    room = Room(memory.left())
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
    return Tree(topology, rows, values, background, active)


def structs(view: memoryview, start: int, dtype: np.dtype[Any], count: int, what: str) -> Nodes:
    """(count,) of a dtype, a view. Raises InvalidFile unless all of it is there."""
    end = start + count * dtype.itemsize
    if start < 0 or end > len(view):
        raise InvalidFile(Problem(what, f"would stand at bytes {start:,} to {end:,}", f"0 to {len(view):,}"))
    return np.frombuffer(view[start:end], dtype)


def _sorted(stored: VdbTopology) -> tuple[VdbTopology, Ints | None]:
    topology, rows = stored.in_order()
    for problem in topology.structure_problems():
        raise InvalidFile(problem)
    return topology, rows


def _index(
    own: VdbTopology, leaf: Nodes, voxels: int, upper: Nodes, lower: Nodes, entries: Nodes, is_node: Bits
) -> Tree:
    if upper["tiles"].any() or lower["tiles"].any() or entries["state"][~is_node].any():
        raise InvalidFile(Problem("the index", "has active tiles", "an index of voxels"))
    if voxels != own.m:
        raise InvalidFile(Problem("TreeData", f"counts {voxels:,} voxels", f"{own.m:,}, the leaves' bits"))
    if (leaf["first"] != own.first + 1).any():
        raise InvalidFile(Problem("the leaves", "number their voxels otherwise", "from 1 on, leaf after leaf"))
    nothing = np.zeros((0, 1), np.float32)
    return Tree(*_sorted(own), nothing, nothing[:, 0], np.zeros(0, bool))


# -- nodes -----------------------------------------------------------------------------------------------------
def _leaves(
    view: memoryview, layout: nano.Layout, start: int, count: int, lower: Nodes, lower_at: int
) -> tuple[Nodes, Codes]:
    size = layout.leaf.itemsize
    if layout is not nano.FPN:
        leaf = structs(view, start, layout.leaf, count, "leaves")
        return leaf, Codes(start + np.arange(count) * size, np.zeros(count, np.int64))
    # Of FpN each leaf says how long it is: nodes point to where it starts.
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
    return leaf, Codes(at, bits)


def _require_links(nodes: Nodes, masks: Nodes, start: int, children: Ints, what: str) -> None:
    """Raises InvalidFile unless the nodes' children stand where these are, in the order of the masks' bits."""
    row, slot = slots_of(masks)
    offset = children - (start + row * nodes.dtype.itemsize)
    wrong = nodes["table"][row, slot, 0] != offset
    if wrong.any():
        first = int(np.argmax(wrong))
        found = f"points {int(nodes['table'][row[first], slot[first], 0]):,} bytes on"
        raise InvalidFile(Problem(f"{what}[{row[first]}].child[{slot[first]}]", found, f"{int(offset[first]):,}"))


def _require_places(leaf: Nodes, own: VdbTopology) -> None:
    wrong = ((leaf["low"] & ~7) != own.leaf_origin).any(axis=1) & own.leaf_mask.any(axis=1)
    if wrong.any():
        first = int(np.argmax(wrong))
        found, right = leaf["low"][first].tolist(), own.leaf_origin[first].tolist()
        raise InvalidFile(Problem(f"leaf {first}", f"lies at {found}", f"{right} and the 7 voxels on"))


def _origins(keys: npt.NDArray[np.uint64]) -> npt.NDArray[np.int32]:
    """(u, 3) the lowest voxels of root tiles."""
    numbers = np.stack([keys >> np.uint64(42), keys >> np.uint64(21), keys], axis=1).astype(np.int64) & 0xFFFFF
    return (((numbers + (1 << 19)) % (1 << 20) - (1 << 19)) * 4096).astype(np.int32)
