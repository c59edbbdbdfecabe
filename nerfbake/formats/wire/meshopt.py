"""Decompress buffer views of KHR_meshopt_compression and EXT_meshopt_compression, which has less.

Source: both extensions, with the bit streams in appendix A and the filters in appendix B.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from nerfbake import memory
from nerfbake.errors import InvalidFile, Problem
from nerfbake.kernels.arrays import Floats

MODES = ("ATTRIBUTES", "TRIANGLES", "INDICES")
FILTERS = ("NONE", "OCTAHEDRAL", "QUATERNION", "EXPONENTIAL", "COLOR")
_VERSION_1 = 0xA1  # first byte of attributes
# Bytes of attributes for each of the stream: a delta of 0 takes a quarter of a bit, or 256 of them two bits.
_GROWTH, _GROWTH_1 = 64, 1024
_WIDEST = 256  # bytes of an element


def decompress(data: memoryview, *, count: int, stride: int, mode: str, filter_: str, place: str) -> memoryview:
    """Return count x stride bytes. Raises InvalidFile, MemoryLimit before memory is taken.

    mode and filter_ as in the extension. The result is counted until the surrounding memory.scope() ends.
    """
    _require_layout(count, stride, mode, filter_, place)
    growth = _GROWTH_1 if bytes(data[:1]) == bytes([_VERSION_1]) else _GROWTH
    most = growth * len(data) if mode == MODES[0] else 3 * stride * len(data)
    if count * stride > most:
        found = f"declares {count * stride:,} bytes from {len(data):,}"
        raise InvalidFile(Problem(place, found, f"{most:,} at most"))
    memory.hold(place, count * stride)
    from nerfbake.kernels.coding import meshopt  # compiles kernels

    stream = np.frombuffer(data, np.uint8)
    if mode == MODES[0]:
        rows = np.zeros((count, stride), np.uint8)
        if not meshopt.decode_attributes(stream, rows):
            raise _damaged(place, mode)
        with memory.lent(place, 12 * count * stride if filter_ != FILTERS[0] else 0):
            return memoryview(_FILTERS[filter_](rows).reshape(-1).view(np.uint8).data)
    memory.hold(place, 4 * count)
    numbers = np.zeros(count, np.uint32)
    decode = meshopt.decode_triangles if mode == MODES[1] else meshopt.decode_indices
    if not decode(stream, numbers) or (stride == 2 and int(numbers.max(initial=0)) > 0xFFFF):
        raise _damaged(place, mode)
    return memoryview(numbers.astype("<u2" if stride == 2 else "<u4").view(np.uint8).data)


def _damaged(place: str, mode: str) -> InvalidFile:
    return InvalidFile(Problem(place, f"has damaged {mode.lower()}", "a whole stream of meshoptimizer"))


def _require_layout(count: int, stride: int, mode: str, filter_: str, place: str) -> None:
    """Raise InvalidFile for an element that the mode and the filter do not allow."""
    if mode not in MODES or filter_ not in FILTERS:
        raise InvalidFile(Problem(place, f"has {mode[:20]} with {filter_[:20]}", f"{', '.join((*MODES, *FILTERS))}"))
    if mode == MODES[0]:
        strides = {"OCTAHEDRAL": (4, 8), "QUATERNION": (8,), "COLOR": (4, 8)}.get(filter_, range(4, _WIDEST + 1, 4))
        good = stride in strides
    else:
        good = stride in (2, 4) and filter_ == FILTERS[0] and (mode != MODES[1] or count % 3 == 0)
    if not good or not count:
        found = f"has {count:,} elements of {stride} bytes as {mode} with {filter_}"
        raise InvalidFile(Problem(place, found, "an element that the extension allows"))


def _as_they_are(rows: npt.NDArray[np.uint8]) -> npt.NDArray[Any]:
    return rows


def _octahedral(rows: npt.NDArray[np.uint8]) -> npt.NDArray[Any]:
    """Unit vectors of normalised integers, from x and y on an octahedron; the fourth component stays."""
    wide = rows.shape[1] == 8
    stored = rows.view("<i2" if wide else "i1")
    most = 32767 if wide else 127
    x, y, one = (stored[:, k].astype(np.float64) for k in range(3))
    one = np.where(one == 0, 1.0, one)
    x, y = x / one, y / one
    z = 1 - np.abs(x) - np.abs(y)
    below = np.minimum(z, 0)
    x, y = x - np.where(x < 0, below, -below), y - np.where(y < 0, below, -below)
    length = np.sqrt(x * x + y * y + z * z)
    scale = most / np.where(length == 0, 1.0, length)
    out = stored.copy()
    for k, part in enumerate((x, y, z)):
        out[:, k] = _rounded(part * scale, most)
    return out


def _quaternion(rows: npt.NDArray[np.uint8]) -> npt.NDArray[Any]:
    """Unit quaternions of normalised shorts, from three components and the place of the largest."""
    stored = rows.view("<i2")
    one = (stored[:, 3].astype(np.int64) | 3).astype(np.float64)
    three = stored[:, :3].astype(np.float64) / np.where(one == 0, 1.0, one)[:, None] * np.sqrt(0.5)
    largest = np.sqrt(np.maximum(0, 1 - (three * three).sum(axis=1)))
    which = stored[:, 3].astype(np.int64) & 3
    out = np.empty_like(stored)
    every = np.arange(len(out))
    for k in range(3):
        out[every, (which + 1 + k) % 4] = _rounded(three[:, k] * 32767, 32767)
    out[every, which] = _rounded(largest * 32767, 32767)
    return out


def _exponential(rows: npt.NDArray[np.uint8]) -> npt.NDArray[Any]:
    """Floats of 24 bits and an exponent of 8."""
    stored = rows.view("<i4").astype(np.int64)
    with np.errstate(over="ignore"):
        wide = np.ldexp(((stored & 0xFFFFFF) ^ 0x800000) - 0x800000, stored >> 24)
        return np.asarray(wide, "<f4")


def _colour(rows: npt.NDArray[np.uint8]) -> npt.NDArray[Any]:
    """Red, green, blue and alpha, from luma, two differences, and alpha.

    The highest bit of alpha tells how many bits the others have; alpha itself has those below it.
    """
    wide = rows.shape[1] == 8
    stored, signed = (rows.view(kind).astype(np.int64) for kind in (("<u2", "<i2") if wide else ("u1", "i1")))
    luma, orange, green, alpha = stored[:, 0], signed[:, 1], signed[:, 2], stored[:, 3]
    bits = np.searchsorted(2 ** np.arange(16), alpha, side="right")
    most, full = np.maximum((1 << bits) - 1, 1), 65535 if wide else 255
    alpha = alpha & most >> 1
    parts = luma + orange - green, luma + green, luma - orange - green, alpha << 1 | alpha & 1
    out = np.stack([np.floor(part * (full / most) + 0.5) for part in parts], axis=1)
    return np.asarray(np.clip(out, 0, full), "<u2" if wide else "u1")


def _rounded(values: Floats, most: int) -> Floats:
    """To the nearest integer, halves away from 0."""
    whole = np.where(values < 0, -np.floor(0.5 - values), np.floor(values + 0.5))
    return np.asarray(np.clip(whole, -most, most))


_FILTERS = dict(zip(FILTERS, (_as_they_are, _octahedral, _quaternion, _exponential, _colour), strict=True))
