"""Protocol Buffers' varints, many at a time.

A varint holds 7 bits a byte, low bits first; the top bit says that more follow:

    300 = 0b10_0101100   ->   1_0101100  0_0000010

int32 is sign-extended to 64 bits, so a negative number takes ten bytes.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from nerfbake.errors import InvalidFile, Problem

MAX_BYTES = 10


def varint_sizes(values: npt.NDArray[np.int32]) -> int:
    """Bytes that these numbers take as varints."""
    size = values.size + (MAX_BYTES - 1) * int(np.count_nonzero(values < 0))
    for bits in (7, 14, 21, 28):
        size += int(np.count_nonzero(values >= 1 << bits))
    return size


def encode_varints(values: npt.NDArray[np.int32]) -> bytes:
    """These numbers as varints."""
    if not values.size:
        return b""
    low, high = int(values.min()), int(values.max())
    if low >= 0 and high < 128:
        return values.astype(np.uint8).tobytes()
    width = MAX_BYTES if low < 0 else -(-high.bit_length() // 7)
    wide = values.astype(np.int64).view(np.uint64)[:, None]
    shifted = wide >> np.arange(0, 7 * width, 7, dtype=np.uint64)  # column k: the bits from group k up
    used = shifted != 0
    used[:, 0] = True
    more = np.zeros(shifted.shape, np.uint8)
    more[:, :-1] = used[:, 1:]
    digits = (shifted & np.uint64(0x7F)).astype(np.uint8) | more << np.uint8(7)
    return bytes(digits[used])


def decode_varints(data: npt.NDArray[np.uint8]) -> npt.NDArray[np.int32]:
    """The numbers behind a run of varints, cut to 32 bits as protobuf cuts an int32.

    Raises InvalidFile for a number that never ends.
    """
    if not len(data):
        return np.empty(0, np.int32)
    last = data < 0x80
    if last.all():
        return data.astype(np.int32)
    ends = np.flatnonzero(last)
    sizes = np.diff(ends, prepend=-1)
    if not last[-1] or sizes.max() > MAX_BYTES:
        after = len(data) if not last[-1] else int(ends[np.argmax(sizes > MAX_BYTES)])
        raise InvalidFile(Problem(f"the varint before byte {after:,}", "does not end", f"{MAX_BYTES} bytes a number"))
    starts = ends - sizes + 1
    values = (data[starts] & 0x7F).astype(np.uint32)
    for k in range(1, min(int(sizes.max()), 5)):
        longer = sizes > k
        values[longer] |= (data[starts[longer] + k] & 0x7F).astype(np.uint32) << np.uint32(7 * k)
    return values.view(np.int32)
