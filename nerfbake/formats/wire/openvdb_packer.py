"""What nodes of an OpenVDB file hold, as bytes: openvdb_values draws them."""

from __future__ import annotations

import struct
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake.formats.wire.deflate import deflate
from nerfbake.formats.wire.openvdb_stream import ACTIVE_ONLY, ALL_VALUES
from nerfbake.kernels.arrays import Bits, Words
from nerfbake.kernels.vdb.bitmask import bits_of, exclusive_sum, popcount
from nerfbake.kernels.vdb.runs import reduce_runs

MINUS, CHOSEN = 1, 3  # codes: inactive voxels are minus the background; or that or the background, as a mask says


class Packer(NamedTuple):
    """How data are stored."""

    zipped: bool
    half: bool

    def __call__(self, data: bytes | memoryview) -> bytes | memoryview:
        if not self.zipped or (self.half and not len(data)):
            return data
        return _zipped(data)


class NodeValues:
    """What each of a run of nodes stores: its code, and the data behind it.

    held (p, w) the slots that have values of their own, active (p, w) those of them that are active, children (p, w)
    those that are nodes; values (q, c) of the held slots, node after node.
    """

    def __init__(
        self, held: Words, active: Words, children: Words | None, values: npt.NDArray[Any], background: Any
    ) -> None:
        self._held, self._active, self._background = held, active, background
        self._values = np.ascontiguousarray(values, values.dtype.newbyteorder("<"))
        self._first = np.append(exclusive_sum(counts := popcount(held)), counts.sum())
        self._is_active: Bits = bits_of(active)[bits_of(held)]
        minus = self._is_active | (self._values == -background.astype(values.dtype)).all(axis=1)
        other = ~reduce_runs(np.logical_and, minus, counts, True)
        everywhere = (held | (0 if children is None else children)) == ~np.uint64(0)
        inactive = (held & ~active).any(axis=1)
        self.code = np.where(inactive, np.where(everywhere.all(axis=1), MINUS, CHOSEN), ACTIVE_ONLY)
        self.code[other] = ALL_VALUES

    def stored(self, node: int, pack: Packer) -> bytes:
        """A node's code and what follows it."""
        code, run = int(self.code[node]), slice(self._first[node], self._first[node + 1])
        values = self._values[run]
        if code == ALL_VALUES:
            slots = bits_of(self._held[node])
            dense = np.zeros((len(slots), values.shape[1]), values.dtype)
            dense[:] = self._background
            dense[slots] = values
            values = dense
        else:
            values = values[self._is_active[run]]
        mask = (~(self._held[node] & ~self._active[node])).astype("<u8").tobytes() if code == CHOSEN else b""
        return struct.pack("<B", code) + mask + pack(np.ascontiguousarray(values).reshape(-1).view(np.uint8).data)


def _zipped(data: bytes | memoryview) -> bytes:
    packed = deflate(data)
    if len(packed) < len(data):
        return struct.pack("<q", len(packed)) + packed
    return struct.pack("<q", -len(data)) + data
