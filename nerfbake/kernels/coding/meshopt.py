"""Decode the three bit streams of meshoptimizer, with versions 0 and 1 of attributes.

    attributes  a0 | blocks of up to 256 elements | padding | first baseline, `stride` bytes
                a block: for each byte of an element 2 bits for each 16 elements, then their deltas: none, in 2 or 4
                bits, or in bytes; the largest number of 2 or 4 bits stands for a byte behind them
                a1 | the same | padding | first baseline | a mode for each four bytes of an element
                a block: before it 2 bits for each byte of an element, by which its deltas have 0, 1, 2 or 4 bits, or
                1, 2, 4 or 8, or are zeros, or bytes; by the mode they are differences of bytes or of pairs of bytes,
                or bits of four bytes that change, rotated by the high half of the mode
    triangles   e1 | a code for each triangle | numbers | 16 bytes of codes
    indices     d1 or d0 | numbers | 4 bytes

Each function returns False if the stream is damaged, and reads nothing outside it.

Source: EXT_meshopt_compression and KHR_meshopt_compression, appendix A.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from nerfbake.kernels.jit import compiled

Bytes = npt.NDArray[np.uint8]
Numbers = npt.NDArray[np.uint32]
_GROUP = 16  # elements
_FIFO = 16  # entries


@compiled()
def decode_attributes(data: Bytes, out: Bytes) -> bool:
    """Fill out (count, stride) with the elements of a stream. stride: a multiple of 4."""
    count, stride = out.shape
    version = np.int64(data[0]) - 0xA0 if len(data) else -1
    if version != 0 and version != 1:
        return False
    channels = stride // 4 if version == 1 else 0
    tail = stride + channels
    end = len(data) - max(tail, 32 if version == 0 else 24)
    if end < 1:
        return False
    first = len(data) - tail
    for channel in range(channels):
        mode = np.int64(data[first + stride + channel])
        if mode & 15 > 2 or (mode & 15 < 2 and mode > 1):
            return False
    at, most = 1, min(8192 // stride // _GROUP * _GROUP, 256)
    before = data[first : first + stride].copy()
    deltas = np.zeros((stride, most), np.uint8)
    for start in range(0, count, most):
        size = min(most, count - start)
        controls = at
        at += channels
        if at > end:
            return False
        for k in range(stride):
            control: Any = -1 if version == 0 else np.int64(data[controls + k // 4]) >> 2 * (k % 4) & 3
            at = _fill_deltas(data, at, end, control, size, deltas[k])
            if at < 0:
                return False
        for channel in range(stride // 4):
            kind: Any = np.int64(data[first + stride + channel]) if version == 1 else 0
            _add_deltas(deltas, 4 * channel, kind, size, before, out[start : start + size])
    return bool(at == end)


@compiled()
def _fill_deltas(data: Bytes, at: int, end: int, control: int, size: int, deltas: Bytes) -> int:
    """Write one byte of each delta of a block; return where they end, -1 if that is beyond the stream.

    control: of version 1 which numbers of bits the groups have, 2 for zeros, 3 for bytes as they are; of version 0 -1.
    """
    if control == 2:
        deltas[:size] = 0
        return at
    if control == 3:
        if at + size > end:
            return -1
        for i in range(size):
            deltas[i] = data[at + i]
        return at + size
    groups = (size + _GROUP - 1) // _GROUP
    heads = at
    at += (groups + 3) // 4
    if at > end:
        return -1
    for group in range(groups):
        mode = np.int64(data[heads + group // 4]) >> 2 * (group % 4) & 3
        bits = (0, 2, 4, 8)[mode] if control < 0 else (0, 1, 2, 4)[mode] if control == 0 else (1, 2, 4, 8)[mode]
        more = at + 2 * bits  # where bytes stand for numbers that do not fit
        if more > end:
            return -1
        for i in range(_GROUP):
            delta: Any = 0  # int() of a byte is unsigned, and with a signed number a float
            if bits == 8:
                delta = np.int64(data[at + i])
            elif bits:
                place, largest = i * bits, (1 << bits) - 1
                shift = (
                    place % 8 if bits == 1 else 8 - bits - place % 8
                )  # the lowest bit is first, but else the highest
                delta = np.int64(data[at + place // 8]) >> shift & largest
                if delta == largest:
                    if more >= end:
                        return -1
                    delta = np.int64(data[more])
                    more += 1
            deltas[group * _GROUP + i] = delta
        at = more
    return at


@compiled()
def _add_deltas(deltas: Bytes, first: int, mode: int, size: int, before: Bytes, out: Bytes) -> None:
    """Write four bytes of each element of a block. mode: bytes (0), pairs (1), or rotated bits (2).

    before: the element before the block, which becomes the last one of it.
    """
    if mode & 15 == 2:
        turn = mode >> 4
        for i in range(size):
            delta: Any = np.int64(0)
            for k in range(4):
                delta |= np.int64(deltas[first + k, i]) << 8 * k
            delta = (delta >> turn | delta << 32 - turn) & 0xFFFFFFFF
            for k in range(4):
                before[first + k] ^= np.uint8(delta >> 8 * k & 0xFF)
                out[i, first + k] = before[first + k]
        return
    wide = 1 + (mode & 1)
    for i in range(size):
        for k in range(first, first + 4, wide):
            step: Any = np.int64(deltas[k, i])
            value: Any = np.int64(before[k])
            if wide == 2:
                step |= np.int64(deltas[k + 1, i]) << 8
                value |= np.int64(before[k + 1]) << 8
            value += ~(step >> 1) if step & 1 else step >> 1
            for j in range(wide):
                before[k + j] = np.uint8(value >> 8 * j & 0xFF)
                out[i, k + j] = before[k + j]


@compiled()
def _number(data: Bytes, at: int, end: int) -> tuple[int, int]:
    """A number of up to 32 bits, 7 in a byte, low ones first, and where it ends; -1 if it does not."""
    value: Any = 0
    for k in range(5):
        if at >= end:
            return 0, -1
        byte: Any = np.int64(data[at])
        at += 1
        value |= (byte & 0x7F) << 7 * k
        if byte < 0x80:
            return value & 0xFFFFFFFF, at
    return 0, -1


@compiled()
def decode_indices(data: Bytes, out: Numbers) -> bool:
    """Fill out (count,) with the numbers of a stream."""
    end = len(data) - 4
    if end < 1 or (data[0] != 0xD1 and data[0] != 0xD0):
        return False
    at = 1
    last = [0, 0]
    for i in range(len(out)):
        value, at = _number(data, at, end)
        if at < 0:
            return False
        which, value = value & 1, value >> 1
        delta = ~(value >> 1) if value & 1 else value >> 1
        last[which] = (last[which] + delta) & 0xFFFFFFFF
        out[i] = last[which]
    return at == end


@compiled()
def decode_triangles(data: Bytes, out: Numbers) -> bool:
    """Fill out (3 triangles,) with the indices of a stream."""
    count, tail = len(out) // 3, len(data) - 16
    if tail < 1 + count or data[0] != 0xE1:
        return False
    at = 1 + count
    edges = np.zeros((_FIFO, 2), np.int64)
    vertices = np.zeros(_FIFO, np.int64)
    edge = vertex = upcoming = last = 0  # the next places in the queues, the next new index, the last explicit one
    for i in range(count):
        code = np.int64(data[1 + i])
        high, low = code >> 4, code & 15
        if high < 15:
            a, b = edges[(edge - 1 - high) & 15]
            added = True
            if low == 0:
                c = upcoming
                upcoming += 1
            elif low < 13:
                c = vertices[(vertex - 1 - low) & 15]
                added = False
            else:
                if low == 15:
                    value, at = _number(data, at, tail)
                    if at < 0:
                        return False
                    last += ~(value >> 1) if value & 1 else value >> 1
                else:
                    last += 1 if low == 14 else -1
                last &= 0xFFFFFFFF
                c = last
            if added:
                vertices[vertex & 15] = c
                vertex += 1
        else:
            if low < 14:
                pair, first = np.int64(data[tail + low]), True
            else:
                if at >= tail:
                    return False
                pair, first = np.int64(data[at]), low == 14
                at += 1
                if pair == 0:
                    upcoming = 0
            z, w = pair >> 4, pair & 15
            explicit = low >= 14
            a = b = c = 0
            for corner in range(3):
                kind = (0 if first else 15) if corner == 0 else (z if corner == 1 else w)
                if kind == 0:
                    found = upcoming
                    upcoming += 1
                elif kind == 15 and explicit:
                    value, at = _number(data, at, tail)
                    if at < 0:
                        return False
                    last = (last + (~(value >> 1) if value & 1 else value >> 1)) & 0xFFFFFFFF
                    found = last
                else:
                    found = vertices[(vertex - kind) & 15]
                if corner == 0:
                    a = found
                elif corner == 1:
                    b = found
                else:
                    c = found
            # The queue is read for all three corners before it grows.
            vertices[vertex & 15] = a
            vertex += 1
            if z == 0 or (explicit and z == 15):
                vertices[vertex & 15] = b
                vertex += 1
            if w == 0 or (explicit and w == 15):
                vertices[vertex & 15] = c
                vertex += 1
            edges[edge & 15, 0], edges[edge & 15, 1] = b, a
            edge += 1
        edges[edge & 15, 0], edges[edge & 15, 1] = c, b
        edge += 1
        edges[edge & 15, 0], edges[edge & 15, 1] = a, c
        edge += 1
        out[3 * i], out[3 * i + 1], out[3 * i + 2] = a, b, c
    return at == tail
