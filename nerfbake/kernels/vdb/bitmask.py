"""Masks of VDB nodes as bits of 64-bit words, sums over runs of rows, and positions of voxels and nodes in the tree.

Slot s of a node is bit s & 63 of word s >> 6. Slots 2, 3 and 64 of a node of 128:

    word 0  ...0000_1100      word 1  ...0000_0001

All functions process many nodes at a time. Runs are consecutive rows, and may be empty.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake.kernels.arrays import Bits, Coords, Floats, Ints, Words


def group_bits(keys: Ints, bits: int) -> tuple[Ints, Words]:
    """Return the distinct parents of sorted, distinct keys, and the mask of each: (p,) keys and (p, 2^bits / 64) words.

    key                        = parent << bits | slot
    with parents numbered      = row << bits | slot       row << (bits - 6) | slot >> 6 is the place of the word
    """
    parents = keys >> bits
    new = np.diff(parents, prepend=-1) != 0
    words: Words = np.zeros((int(np.count_nonzero(new)), (1 << bits) // 64), np.uint64)
    if len(keys):
        slot = keys & ((1 << bits) - 1)
        word = (np.cumsum(new) - 1 << bits | slot) >> 6
        starts = np.flatnonzero(np.diff(word, prepend=-1))
        bit = np.uint64(1) << (slot & 63).astype(np.uint64)
        words.reshape(-1)[word[starts]] = np.bitwise_or.reduceat(bit, starts)
    return parents[new], words


def slots_of(masks: Words) -> tuple[Ints, Ints]:
    """The row and the slot of every set bit, row by row, slots rising."""
    octets = np.ascontiguousarray(masks, "<u8").reshape(-1).view(np.uint8)
    return np.divmod(np.flatnonzero(np.unpackbits(octets, bitorder="little")), max(masks.shape[1] * 64, 1))


def bits_of(masks: Words) -> Bits:
    """(..., w) words -> (..., 64 w) whether each slot's bit is set."""
    octets = np.ascontiguousarray(masks, "<u8").view(np.uint8)
    return np.unpackbits(octets, axis=-1, bitorder="little").view(np.bool_)


def words_of(bits: Bits) -> Words:
    """(..., 64 w) -> (..., w) words: the inverse of bits_of()."""
    return np.packbits(bits, axis=-1, bitorder="little").view("<u8").astype(np.uint64, copy=False)


def popcount(masks: Words) -> Ints:
    """(p,) number of set bits of each row."""
    counts: Ints = np.bitwise_count(masks).sum(axis=1, dtype=np.int64)
    return counts


def prefix_counts(masks: Words) -> Ints:
    """(p, words) number of set bits of a row before each of its words."""
    counts = np.bitwise_count(masks).astype(np.int64)
    return np.cumsum(counts, axis=1) - counts


def exclusive_sum(counts: Ints) -> Ints:
    """The sum of all counts before each: [3, 1, 2] -> [0, 3, 4]."""
    return np.cumsum(counts) - counts


def numbers_of(masks: Words, row: Ints, slot: Ints) -> Ints:
    """(q,) number of set bits of all rows before this slot's bit; -1 if that bit is not set, or row is -1."""
    words = np.append(masks.reshape(-1), np.uint64(0))  # an empty word for row -1
    ranks = exclusive_sum(np.bitwise_count(words).astype(np.int64))
    place = np.where(row < 0, len(words) - 1, row * masks.shape[1] + (slot >> 6))
    word, bit = words[place], (slot & 63).astype(np.uint64)
    below = np.bitwise_count(word & ((np.uint64(1) << bit) - np.uint64(1)))
    return np.where(word >> bit & np.uint64(1), ranks[place] + below, -1)


def bits_kept(masks: Words, keep: Bits) -> Words:
    """Clear some of the set bits of masks: keep is (all set bits,), row by row, slots rising."""
    bits = bits_of(masks)
    bits[bits] = keep
    return words_of(bits)


_RUNS = 1 << 10  # runs at a time


def reduce_runs(ufunc: np.ufunc, rows: npt.NDArray[Any], counts: Ints, empty: float) -> npt.NDArray[Any]:
    """(p, ...) the ufunc over each run; `empty` for a run without rows. The first run is counts[0] rows, and so on."""
    out = np.full((len(counts), *rows.shape[1:]), empty, rows.dtype)
    filled = counts > 0
    if filled.any():
        out[filled] = ufunc.reduceat(rows, exclusive_sum(counts)[filled], axis=0)
    return out


def rows_of_runs(counts: Ints, order: Ints) -> Ints:
    """The rows of all runs, with the runs in another order: counts [2, 1], order [1, 0] -> [2, 0, 1]."""
    return _rows(exclusive_sum(counts)[order], counts[order])


def in_order_of(runs: npt.NDArray[Any], counts: Ints, order: Ints) -> npt.NDArray[Any]:
    """The values of all runs, with the runs in another order.

    One part at a time, because row numbers take more memory than values.
    """
    starts, out, done = exclusive_sum(counts), np.empty(int(counts[order].sum()), runs.dtype), 0
    for begin in range(0, len(order), _RUNS):
        some = order[begin : begin + _RUNS]
        rows = _rows(starts[some], counts[some])
        out[done : done + len(rows)] = runs[rows]
        done += len(rows)
    return out


def _rows(starts: Ints, lengths: Ints) -> Ints:
    """The rows of runs with these starts and lengths, one run after the other."""
    return np.arange(int(lengths.sum())) + np.repeat(starts - exclusive_sum(lengths), lengths)


class RunSpread(NamedTuple):
    """For each run: count, minimum, maximum, mean, and the sum of squared deviations from the mean."""

    size: Ints
    low: npt.NDArray[np.float32]
    high: npt.NDArray[np.float32]
    mean: Floats
    squares: Floats

    @property
    def deviation(self) -> Floats:
        """(p,) population standard deviations."""
        return np.sqrt(self.squares / np.maximum(self.size, 1))


def spread_of(values: npt.NDArray[np.float32], counts: Ints, *, weight: int = 1) -> RunSpread:
    """The spread of runs of numbers: values (m,), each of which counts `weight` times."""
    exact = values.astype(np.float64)
    mean = reduce_runs(np.add, exact, counts, 0) / np.maximum(counts, 1)
    squares = weight * reduce_runs(np.add, (exact - np.repeat(mean, counts)) ** 2, counts, 0)
    low = reduce_runs(np.minimum, values, counts, np.inf)
    return RunSpread(weight * counts, low, reduce_runs(np.maximum, values, counts, -np.inf), mean, squares)


def spread_with(one: RunSpread, other: RunSpread) -> RunSpread:
    """Merge the spread of each run of `one` with that of `other`: the result of spread_of() for both."""
    arrays: zip[tuple[npt.NDArray[Any], npt.NDArray[Any]]] = zip(one, other, strict=True)
    return spread_over(RunSpread(*(np.stack(both, axis=1).reshape(-1) for both in arrays)), np.full(len(one.size), 2))


def spread_over(parts: RunSpread, counts: Ints) -> RunSpread:
    """Merge runs of spreads: the result of spread_of() for all their numbers together."""
    count = reduce_runs(np.add, parts.size, counts, 0)
    mean = reduce_runs(np.add, parts.mean * parts.size, counts, 0) / np.maximum(count, 1)
    apart = parts.size * (parts.mean - np.repeat(mean, counts)) ** 2
    low = reduce_runs(np.minimum, parts.low, counts, np.inf)
    high = reduce_runs(np.maximum, parts.high, counts, -np.inf)
    return RunSpread(count, low, high, mean, reduce_runs(np.add, parts.squares + apart, counts, 0))


ROOT_BITS = 20  # of a tile number along an axis
FAR = 1 << 40  # outside every tile, and still within the range of integers


def root_keys(coords: npt.NDArray[np.integer[Any]]) -> Ints:
    """(m,) the numbers by which root tiles are sorted, the same as in NanoVDB; coords (m, 3)."""
    x, y, z = (coords[:, axis].astype(np.int64) >> 12 & (1 << ROOT_BITS) - 1 for axis in range(3))
    return x << 42 | y << 21 | z


def slots_at(coords: npt.NDArray[np.integer[Any]], bits: int, shift: int) -> Ints:
    """(q,) the slot of each voxel in a node with 2^bits slots along an axis, each 2^shift voxels wide."""
    x, y, z = (coords[:, axis].astype(np.int64) >> shift & (1 << bits) - 1 for axis in range(3))
    return x << 2 * bits | y << bits | z


def tiles_at(keys: Ints, wanted: Ints, coords: npt.NDArray[np.integer[Any]]) -> Ints:
    """(q,) the index of each wanted key among sorted keys; -1 if it is missing, or beyond 32 bits."""
    if not len(keys):
        return np.full(len(wanted), -1)
    place = np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)
    near = ((coords >= -(1 << 31)) & (coords < 1 << 31)).all(axis=1)
    return np.where((keys[place] == wanted) & near, place, -1)


def origins_of(above: Coords, masks: Words, bits: int, width: int) -> Coords:
    """(p, 3) the lowest voxel of the child of each set bit.

    above: the lowest voxels of the nodes, which have 2^bits slots along an axis, each `width` voxels wide.
    """
    row, slot = slots_of(masks)
    low = (1 << bits) - 1
    step = np.stack([slot >> 2 * bits, slot >> bits & low, slot & low], axis=1).astype(np.int32)
    return above[row] + step * np.int32(width)
