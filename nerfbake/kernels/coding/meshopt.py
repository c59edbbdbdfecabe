"""Decode the three bit streams of meshoptimizer, version 0 of attributes.

    attributes  a0 | blocks of up to 256 elements | padding | first baseline, `stride` bytes
                a block: for each byte of an element 2 bits for each 16 elements, then their deltas: none, in 2 or 4
                bits, or in bytes; the largest number of 2 or 4 bits stands for a byte behind them
    triangles   e1 | a code for each triangle | numbers | 16 bytes of codes
    indices     d1 or d0 | numbers | 4 bytes

Each function returns False if the stream is damaged, and reads nothing outside it.

Source: EXT_meshopt_compression, appendix A.
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
    """Fill out (count, stride) with the elements of a stream."""
    count, stride = out.shape
    end = len(data) - max(stride, 32)
    if end < 1 or data[0] != 0xA0:
        return False
    at, most = 1, min(8192 // stride // _GROUP * _GROUP, 256)
    before = data[len(data) - stride :].copy()
    for start in range(0, count, most):
        size = min(most, count - start)
        groups = (size + _GROUP - 1) // _GROUP
        for k in range(stride):
            heads = at
            at += (groups + 3) // 4
            if at > end:
                return False
            value: Any = np.int64(before[k])  # int() of a byte is unsigned, and with a signed number a float
            for group in range(groups):
                mode = np.int64(data[heads + group // 4]) >> 2 * (group % 4) & 3
                bits = (0, 2, 4, 8)[mode]
                more = at + 2 * bits  # where bytes stand for numbers that do not fit
                if more > end:
                    return False
                for i in range(_GROUP):
                    delta: Any = 0
                    if bits == 8:
                        delta = np.int64(data[at + i])
                    elif bits:
                        place = i * bits
                        largest = (1 << bits) - 1
                        delta = np.int64(data[at + place // 8]) >> (8 - bits - place % 8) & largest
                        if delta == largest:
                            if more >= end:
                                return False
                            delta = np.int64(data[more])
                            more += 1
                    row = start + group * _GROUP + i
                    if row < start + size:
                        step = ~(delta >> 1) if delta & 1 else delta >> 1
                        value = (value + step) & 0xFF
                        out[row, k] = value
                at = more
            before[k] = value
    return bool(at == end)


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
