"""The whole numbers of a .svoq as zlib streams, for readers who would rather write no range decoder.

topology       the masks, a byte each
coefficients   rows 1, 2, ...: for each row how many channels of colour come before its zeros begin, a byte;
               then of channel 0 all rows that have it, of channel 1 those that have that, and so on; of density all.
               A number is 2v, or -2v - 1 where v is below 0, a byte; 255 stands for one of 255 or more, which is
               behind all others as a u32, in the same order
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from nerfbake import memory
from nerfbake.errors import InvalidFile, Problem
from nerfbake.formats.wire.deflate import deflate_best, inflate
from nerfbake.formats.wire.svoq import COEFFICIENTS, TOPOLOGY, Part
from nerfbake.scene.quantised_octree import MAX_VALUE

_LARGE = 255


def deflated(masks: npt.NDArray[np.uint8], values: npt.NDArray[np.int32]) -> list[Part]:
    """The parts of masks (c,) and values (m, C), row 0 left out."""
    rows, C = values[1:], values.shape[1]
    filled = rows[:, :-1] != 0
    lengths = ((C - 1 - filled[:, ::-1].argmax(axis=1)) * filled.any(axis=1)).astype(np.uint8)
    pieces, large = [lengths], [np.zeros(0, np.uint32)]
    for channel in range(C):
        some = (rows[:, channel] if channel == C - 1 else rows[lengths > channel, channel]).astype(np.int64)
        unsigned = np.where(some < 0, -2 * some - 1, 2 * some).astype(np.uint32)
        pieces.append(np.minimum(unsigned, _LARGE).astype(np.uint8))
        large.append(unsigned[unsigned >= _LARGE])
    whole = b"".join(piece.tobytes() for piece in pieces) + np.concatenate(large).astype("<u4").tobytes()
    return [_part(TOPOLOGY, 0, masks.tobytes()), _part(COEFFICIENTS, C, whole)]


def inflated_masks(part: Part, c: int) -> npt.NDArray[np.uint8]:
    """(c,) masks. Raises InvalidFile, MemoryLimit."""
    if part.unpacked != c:
        raise InvalidFile(Problem("topology", f"unpacks to {part.unpacked:,} bytes", f"{c:,}, one a mask"))
    return np.frombuffer(inflate(part.data, c, "topology"), np.uint8).copy()


def inflate_values(part: Part, values: npt.NDArray[np.int32]) -> None:
    """Fills (m, C) values, all but row 0. Raises InvalidFile, MemoryLimit."""
    rows, C = values[1:], values.shape[1]
    if part.unpacked > 5 * rows.size + len(rows):
        found = f"unpack to {part.unpacked:,} bytes"
        raise InvalidFile(Problem("coefficients", found, f"up to {5 * rows.size + len(rows):,} for {len(rows):,} rows"))
    memory.require("the coefficients", part.unpacked + 13 * len(rows))
    data = np.frombuffer(inflate(part.data, part.unpacked, "coefficients"), np.uint8)
    lengths = data[: len(rows)]
    counts = [*(int(np.count_nonzero(lengths > channel)) for channel in range(C - 1)), len(rows)]
    end = len(rows) + sum(counts)
    large = data[end:]
    if (
        end > len(data)
        or int(lengths.max(initial=0)) > C - 1
        or 4 * int(np.count_nonzero(data[len(rows) : end] == _LARGE)) != len(large)
    ):
        raise InvalidFile(Problem("coefficients", f"unpack to {len(data):,} bytes", "as many as its lengths say"))
    numbers, begin, used = large.view("<u4") if len(large) % 4 == 0 else large, len(rows), 0
    for channel, count in enumerate(counts):
        unsigned = data[begin : begin + count].astype(np.int64)
        escaped = np.flatnonzero(unsigned == _LARGE)
        unsigned[escaped] = numbers[used : used + len(escaped)]
        begin, used = begin + count, used + len(escaped)
        if int(unsigned.max(initial=0)) > 2 * MAX_VALUE:
            raise InvalidFile(Problem("coefficients", f"hold {int(unsigned.max()):,}", f"{2 * MAX_VALUE:,} (unsigned)"))
        signed = np.where(unsigned & 1, -(unsigned + 1 >> 1), unsigned >> 1)
        if channel == C - 1:
            rows[:, channel] = signed
        else:
            rows[lengths > channel, channel] = signed


def _part(kind: int, end: int, data: bytes) -> Part:
    return Part(kind, end, memoryview(deflate_best(data)), len(data))
