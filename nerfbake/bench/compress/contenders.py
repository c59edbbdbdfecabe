"""What others make of an octree's leaves: the same topology, a byte a mask, and what the leaves hold, in fewer bytes.

    float16      all values, by a general compressor
    palette      K whole vectors of coefficients (K-means), a number a leaf, density as float16
    median cut   for each function of the basis a table of colours (red, green, blue) and a number a leaf, density as
                 float16: PlenOctrees' own quantisation, as its dialect of N3Tree holds it (docs/formats/n3tree.md)

Palettes and tables are deflated. No row holds inner nodes, which all readers can make anew.
"""

from __future__ import annotations

import lzma
import zlib
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

Singles = npt.NDArray[np.float32]
Numbers = npt.NDArray[np.int64]

_SAMPLE = 100_000  # leaves that a palette is found from
_BATCH = 1 << 14


class Packed(NamedTuple):
    """data: the bytes; values (m, D) float32: what the leaves hold afterwards."""

    data: bytes
    values: Singles


Contender = Callable[[bytes, Singles], Packed]  # from the topology and what the leaves hold, density last


def contenders() -> dict[str, tuple[str, Contender]]:
    """By name: what they are grouped by in a chart, and how they pack."""
    found: dict[str, tuple[str, Contender]] = {
        "float16, deflate": ("float16", _whole(_deflated)),
        "float16, zstd": ("float16", _whole(_zstd)),
        "float16, xz": ("float16", _whole(lzma.compress)),
    }
    for K in (256, 1024, 4096):
        found[f"palette of {K:,}"] = ("palette", _palette(K))
    for bits in (8, 12, 16):
        found[f"median cut to {1 << bits:,}"] = ("median cut", _median_cut(bits))
    return found


def _deflated(data: bytes) -> bytes:
    return zlib.compress(data, 9)


def _zstd(data: bytes) -> bytes:
    import zstandard

    return zstandard.ZstdCompressor(19).compress(data)


def _whole(pack: Callable[[bytes], bytes]) -> Contender:
    def packed(topology: bytes, values: Singles) -> Packed:
        half = _half(values)
        return Packed(pack(topology + half.tobytes()), half.astype(np.float32))

    return packed


def _palette(K: int) -> Contender:
    def packed(topology: bytes, values: Singles) -> Packed:
        from sklearn.cluster import MiniBatchKMeans

        colours = values[:, :-1]
        some = colours[:: -(-len(colours) // _SAMPLE)]
        means = MiniBatchKMeans(min(K, len(some)), n_init=1, random_state=0, batch_size=_BATCH).fit(some)
        numbers = means.predict(colours).astype(np.uint16 if K > 256 else np.uint8)
        return _from_tables(topology, [_half(means.cluster_centers_)], [numbers], values)

    return packed


def _median_cut(bits: int) -> Contender:
    def packed(topology: bytes, values: Singles) -> Packed:
        m, B = len(values), values.shape[1] // 3
        colours = values[:, :-1].reshape(m, 3, B)
        tables, numbers = [], []
        for function in range(B):
            table, number = median_cut(colours[:, :, function], bits)
            tables.append(_half(table))
            numbers.append(number.astype(np.uint16 if bits > 8 else np.uint8))
        return _from_tables(topology, tables, numbers, values)

    return packed


def median_cut(points: Singles, bits: int) -> tuple[Singles, Numbers]:
    """(2^bits, 3) the means of boxes, and (m,) the box of each of (m, 3) points.

    All points are one box at first. Each box is cut, `bits` times, at the median of the axis along which it is longest.
    Source: Heckbert, "Color image quantization for frame buffer display", 1982.
    """
    box = np.zeros(len(points), np.int64)
    for depth in range(bits):
        low, high = (np.full((1 << depth, 3), sign * np.inf, np.float32) for sign in (1, -1))
        np.minimum.at(low, box, points)
        np.maximum.at(high, box, points)
        with np.errstate(invalid="ignore"):
            axis = np.argmax(np.nan_to_num(high - low), axis=1)
        order = np.lexsort((points[np.arange(len(points)), axis[box]], box))
        counts = np.bincount(box, minlength=1 << depth)
        rank = np.empty(len(points), np.int64)
        rank[order] = np.arange(len(points)) - np.repeat(np.cumsum(counts) - counts, counts)
        box = 2 * box + (2 * rank >= counts[box])
    counts = np.bincount(box, minlength=1 << bits)
    sums = np.stack([np.bincount(box, points[:, c], 1 << bits) for c in range(3)], axis=1)
    return (sums / np.maximum(counts, 1)[:, None]).astype(np.float32), box


def _from_tables(topology: bytes, tables: list[Any], numbers: list[Any], values: Singles) -> Packed:
    """One table of all coefficients, or a table of three of them for each function of the basis."""
    sigma, back = _half(values[:, -1]), np.empty_like(values)
    B = values.shape[1] // 3
    for function, (table, number) in enumerate(zip(tables, numbers, strict=True)):
        back[:, slice(0, -1) if len(tables) == 1 and B > 1 else slice(function, -1, B)] = table[number]
    back[:, -1] = sigma
    pieces = [topology, *(array.tobytes() for array in (*tables, *numbers, sigma))]
    return Packed(_deflated(b"".join(pieces)), back)


def _half(values: npt.NDArray[Any]) -> npt.NDArray[np.float16]:
    found: npt.NDArray[np.float16] = np.clip(values, -65504, 65504).astype(np.float16)
    return found
