"""One tree of an OpenVDB file: masks and tiles, node behind node, and then the values of all leaves."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake import memory
from nerfbake.errors import InvalidFile, Problem
from nerfbake.formats.wire.openvdb_stream import Stream
from nerfbake.formats.wire.openvdb_values import Kind, read_leaves, read_slots
from nerfbake.formats.wire.vdb_held import Held
from nerfbake.kernels.arrays import Words
from nerfbake.kernels.maths.casting import cast
from nerfbake.kernels.vdb.bitmask import popcount
from nerfbake.scene.vdb_tiles import VdbTiles
from nerfbake.scene.vdb_topology import VdbTopology


class Tree(NamedTuple):
    """A grid but for its name and its place: scene.vdb.VdbTree says what each field is."""

    topology: VdbTopology
    values: npt.NDArray[Any]
    background: npt.NDArray[np.float32]
    active: npt.NDArray[np.bool_]


def read_tree(stream: Stream, kind: Kind, flags: int, what: str) -> Tree:
    """Raises InvalidFile, MemoryLimit."""
    nodes = _Nodes(stream, kind, flags, what)
    leaves = read_leaves(stream, nodes.leaf_mask, kind, flags, nodes.background, what)
    parts = [leaves, *nodes.tiles]
    tiles = VdbTiles(nodes.tiles[0].mask, nodes.tiles[1].mask, nodes.tile_origin)
    stored = VdbTopology(nodes.root_origin, nodes.upper_mask, nodes.lower_mask, leaves.mask, tiles)
    for problem in stored.mask_problems():
        raise InvalidFile(problem)
    values, active = (np.concatenate([getattr(part, name) for part in parts]) for name in ("values", "active"))
    topology, rows = stored.in_order()
    for problem in topology.structure_problems():
        raise InvalidFile(problem)
    if rows is not None:
        values, active = values[rows], active[rows]
    return Tree(topology, values, cast(nodes.background, np.float32), active)


class _Nodes:
    """All masks, and the tiles, in the file's order."""

    def __init__(self, stream: Stream, kind: Kind, flags: int, what: str) -> None:
        self._stream, self._kind, self._flags, self._what = stream, kind, flags, what
        (buffers,) = stream.numbers("I", what)
        if buffers != 1:
            raise InvalidFile(Problem(what, f"has {buffers:,} buffers a leaf", "1"))
        self.background = kind.read(stream.take(kind.channels * kind.full.itemsize, what), kind.full)[0]
        tiles, children = stream.numbers("II", what)
        root, self.tile_origin = self._root_tiles(tiles)
        origins, masks = [], (list[Words](), list[Words](), list[Words]())
        uppers: list[Held | None] = []
        lowers: list[Held | None] = []
        for _ in range(children):
            origins.append(stream.array("<i4", 3, what))
            upper = self._inner(4096, uppers)
            masks[0].append(upper)
            for _ in range(int(popcount(upper[None])[0])):
                lower = self._inner(512, lowers)
                masks[1].append(lower)
                masks[2].append(stream.array("<u8", 8 * int(popcount(lower[None])[0]), what))
        self.root_origin = np.array(origins, np.int32).reshape(-1, 3)
        self.upper_mask, self.lower_mask, self.leaf_mask = map(_stacked, masks, (512, 64, 8))
        self.tiles = [self._joined(lowers, 64), self._joined(uppers, 512), root]

    def _root_tiles(self, count: int) -> tuple[Held, npt.NDArray[np.int32]]:
        kind = self._kind
        dtype = np.dtype(
            [("origin", "<i4", 3), ("value", kind.full.newbyteorder("<"), kind.channels), ("active", "u1")]
        )
        tiles = np.frombuffer(self._stream.take(count * dtype.itemsize, self._what), dtype)
        values = kind.read(np.ascontiguousarray(tiles["value"]).data, kind.full)
        active = tiles["active"] != 0
        own = active | (values != self.background).any(axis=1)
        return Held(np.zeros((0, 0), np.uint64), values[own], active[own]), tiles["origin"][own].astype(np.int32)

    def _inner(self, size: int, found: list[Held | None]) -> Words:
        """A node's child mask of so many bytes; what its tiles are is put behind `found`."""
        children = self._stream.array("<u8", size // 8, self._what)
        active = self._stream.array("<u8", size // 8, self._what)
        held = read_slots(self._stream, children, active, self._kind, self._flags, self.background, self._what)
        if held is not None:
            memory.hold(self._what, held.values.nbytes)
        found.append(held)
        return children

    def _joined(self, nodes: list[Held | None], width: int) -> Held:
        """The tiles of a level's nodes."""
        mask = np.zeros((len(nodes), width), np.uint64)
        values, active = [np.zeros((0, self._kind.channels), self._kind.held)], [np.zeros(0, bool)]
        for row, node in enumerate(nodes):
            if node is not None:
                mask[row] = node.mask
                values.append(node.values)
                active.append(node.active)
        return Held(mask, np.concatenate(values), np.concatenate(active))


def _stacked(rows: list[Words], width: int) -> Words:
    return np.concatenate(rows or [np.zeros(0, np.uint64)]).astype(np.uint64).reshape(-1, width)
