"""Encode and decode many varints of Protocol Buffers at once.

A varint has 7 bits per byte, low bits first; the top bit is set if more bytes follow:

    300 = 0b10_0101100   ->   1_0101100  0_0000010

int32 is sign-extended to 64 bits, so a negative number takes ten bytes.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from nerfbake.errors import InvalidFile, Problem

MAX_VARINT = 10
_CHUNK = 1 << 18  # bytes decoded at a time


def varint_sizes(values: npt.NDArray[np.int32]) -> int:
    """Bytes that these numbers take as varints."""
    size, low, high = values.size, int(values.min(initial=0)), int(values.max(initial=0))
    if low < 0:
        size += (MAX_VARINT - 1) * int(np.count_nonzero(values < 0))
    for bits in range(7, high.bit_length(), 7):
        size += int(np.count_nonzero(values >= 1 << bits))
    return size


def encode_varints(values: npt.NDArray[np.int32]) -> bytes:
    """Encode these numbers as varints."""
    if not values.size:
        return b""
    low, high = int(values.min()), int(values.max())
    if low >= 0 and high < 128:
        return values.astype(np.uint8).tobytes()
    # Most numbers of a table are 0, which is encoded as a zero byte: only the others are written.
    at = np.flatnonzero(values != 0)
    some = values[at].astype(np.int64).view(np.uint64)
    width = MAX_VARINT if low < 0 else -(-high.bit_length() // 7)
    longer = [some >= np.uint64(1 << 7 * k) for k in range(1, width)] + [np.zeros(len(some), bool)]
    extra = np.add.reduce(longer, dtype=np.int64)
    begin = at + np.cumsum(extra) - extra
    out = np.zeros(len(values) + int(extra.sum()), np.uint8)
    out[begin] = (some & np.uint64(0x7F)).astype(np.uint8) | longer[0] << np.uint8(7)
    for k in range(1, width):
        has = np.flatnonzero(longer[k - 1])
        digit = some[has] >> np.uint64(7 * k) & np.uint64(0x7F)
        out[begin[has] + k] = digit.astype(np.uint8) | longer[k][has] << np.uint8(7)
    return out.tobytes()


def decode_varints(data: npt.NDArray[np.uint8]) -> npt.NDArray[np.int32]:
    """Decode a run of varints, truncated to 32 bits as protobuf truncates an int32.

    Takes 4 bytes per number and a few megabytes. Raises InvalidFile for a varint that does not end.
    """
    parts = [data[start : start + _CHUNK] for start in range(0, len(data), _CHUNK)]
    out = np.empty(sum(int(np.count_nonzero(part < 0x80)) for part in parts), np.int32)
    begin = filled = 0
    while begin < len(data):
        part = data[begin : begin + _CHUNK]
        ends = np.flatnonzero(part < 0x80)
        sizes = np.diff(ends, prepend=-1)
        if not len(ends) or sizes.max() > MAX_VARINT:
            raise InvalidFile(
                Problem(f"a varint after byte {begin:,}", "does not end", f"{MAX_VARINT} bytes per number")
            )
        values = _numbers(part, ends - sizes + 1, sizes)
        out[filled : filled + len(values)] = values
        # A number that is split by the end of the chunk is decoded with the next chunk.
        begin, filled = begin + int(ends[-1]) + 1, filled + len(values)
    return out


def _numbers(
    data: npt.NDArray[np.uint8], starts: npt.NDArray[np.int64], sizes: npt.NDArray[np.int64]
) -> npt.NDArray[np.int32]:
    values = (data[starts] & 0x7F).astype(np.uint32)
    for k in range(1, min(int(sizes.max()), 5)):
        longer = sizes > k
        values[longer] |= (data[starts[longer] + k] & 0x7F).astype(np.uint32) << np.uint32(7 * k)
    return values.view(np.int32)
