"""Sets of slots as bits of 64-bit words, many nodes at a time: the active and child masks of a VDB tree.

Slot s of a node is bit s & 63 of word s >> 6. Slots 2, 3 and 64 of a node of 128:

    word 0  ...0000_1100      word 1  ...0000_0001
"""

from __future__ import annotations

import numpy as np

from nerfbake.kernels.arrays import Bits, Ints, Words


def group_bits(keys: Ints, bits: int) -> tuple[Ints, Words]:
    """The parents that sorted, distinct keys share, and the mask of each: (p,) keys and (p, 2^bits / 64) words.

    key                       = parent << bits | slot
    counted by parent, in turn = row << bits | slot       row << (bits - 6) | slot >> 6 is the word's place
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
    """The row and the slot of every set bit, row after row, slots rising."""
    octets = np.ascontiguousarray(masks, "<u8").reshape(-1).view(np.uint8)
    return np.divmod(np.flatnonzero(np.unpackbits(octets, bitorder="little")), max(masks.shape[1] * 64, 1))


def bits_of(masks: Words) -> Bits:
    """(..., w) words -> (..., 64 w) whether each slot's bit is set."""
    octets = np.ascontiguousarray(masks, "<u8").view(np.uint8)
    return np.unpackbits(octets, axis=-1, bitorder="little").view(np.bool_)


def words_of(bits: Bits) -> Words:
    """(..., 64 w) -> (..., w) words, the way back."""
    return np.packbits(bits, axis=-1, bitorder="little").view("<u8").astype(np.uint64, copy=False)


def popcount(masks: Words) -> Ints:
    """(p,) set bits of each row."""
    counts: Ints = np.bitwise_count(masks).sum(axis=1, dtype=np.int64)
    return counts


def prefix_counts(masks: Words) -> Ints:
    """(p, words) set bits of a row before each of its words."""
    counts = np.bitwise_count(masks).astype(np.int64)
    return np.cumsum(counts, axis=1) - counts


def exclusive_sum(counts: Ints) -> Ints:
    """What stands before each: [3, 1, 2] -> [0, 3, 4]."""
    return np.cumsum(counts) - counts


def numbers_of(masks: Words, row: Ints, slot: Ints) -> Ints:
    """(q,) how many bits of all rows are set before this slot's, where it is set; -1 where it is not, or row is -1."""
    words = np.append(masks.reshape(-1), np.uint64(0))  # nothing stands in the row of what is nowhere
    ranks = exclusive_sum(np.bitwise_count(words).astype(np.int64))
    place = np.where(row < 0, len(words) - 1, row * masks.shape[1] + (slot >> 6))
    word, bit = words[place], (slot & 63).astype(np.uint64)
    below = np.bitwise_count(word & ((np.uint64(1) << bit) - np.uint64(1)))
    return np.where(word >> bit & np.uint64(1), ranks[place] + below, -1)


def bits_kept(masks: Words, keep: Bits) -> Words:
    """The same masks without some of their set bits: keep is (all set bits,), row after row, slots rising."""
    bits = bits_of(masks)
    bits[bits] = keep
    return words_of(bits)
