"""Join deflate streams: find the last block of a stream, and let another stream follow it.

A deflate stream is a sequence of blocks of bits, lowest bit first (RFC 1951):

    bit 0      1 in the last block of the stream, 0 in all others
    bits 1, 2  0 stored: padding to a byte, its length n and ~n in 16 bits each, and n bytes
               1 with a fixed code, 2 with a code that precedes the symbols
    symbols    literals, and matches of a length and a distance, to the symbol that ends the block

No field says where a block ends, so its symbols are read. Nothing is decompressed: an entry of a code's table is the
number of bits to skip, of a symbol together with the extra bits of its length or distance. A table has an entry for
each value of the next bits, as many as the longest code has.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from nerfbake.kernels.jit import compiled

Bytes = npt.NDArray[np.uint8]
Words = npt.NDArray[np.uint64]

_LONGEST = 15  # bits of a code
_MATCH, _END = 32, 64  # flags in an entry, above its number of bits
_INVALID = 1 << 62  # a place beyond every stream
_LITERALS, _DISTANCES = 288, 32  # symbols of the two codes
_ORDER = np.array([16, 17, 18, 0, 8, 7, 9, 6, 10, 5, 11, 4, 12, 3, 13, 2, 14, 1, 15])  # of the lengths of codes' code
# What the entry of a symbol has besides the length of its code: flags and extra bits.
_OF_LITERAL = np.array([0] * 256 + [_END] + [_MATCH + max(0, k // 4 - 1) for k in range(28)] + [_MATCH] * 3, np.uint8)
_OF_DISTANCE = np.array([max(0, k // 2 - 1) for k in range(30)] + [0] * 2, np.uint8)
_OF_LENGTH = np.arange(0, 8 * 19, 8, dtype=np.uint8)  # the symbol; its code has at most 7 bits


def continued(stream: bytes | bytearray) -> memoryview:
    """Return a deflate stream that another one may follow: its last block does not end it, and a byte ends with it.

    An empty stored block of 4 to 5 bytes reaches the end of the byte. The stream must be valid. Raises ValueError if
    its last block does not end in its last byte.
    """
    size = len(stream)
    words = np.zeros(size // 8 + 3, "<u8")  # 64 bits are read from any bit of the stream, and 5 bytes are added
    data = words.view(np.uint8)
    data[:size] = np.frombuffer(stream, np.uint8)
    start, end = last_block(words, 8 * size)
    if -(-end // 8) != size:
        raise ValueError(f"the last block of a deflate stream of {size:,} bytes ends at bit {end:,}")
    data[start >> 3] &= ~(1 << (start & 7)) & 0xFF
    size = (end + 3 + 7) // 8 + 4  # three bits of a stored block, padding, and the length 0 with its complement
    data[size - 2 : size] = 0xFF
    return data[:size].data


@compiled()
def last_block(words: Words, bits: int) -> tuple[int, int]:
    """Return the bits at which the last block of a stream begins and ends, or a place beyond the stream.

    words: the stream of so many bits, and at least one more word.
    """
    literals, distances = np.zeros(1 << _LONGEST, np.uint8), np.zeros(1 << _LONGEST, np.uint8)
    lengths = np.zeros(_LITERALS + _DISTANCES, np.uint8)
    at = 0
    while at < bits:
        start = at
        head = _low(_bits(words, at), 3)
        at += 3
        if head >> 1 == 0:
            at = at + 7 & -8
            if at < bits:
                at += 32 + 8 * _low(_bits(words, at), 16)
        elif head >> 1 < 3:
            count = _LITERALS
            if head >> 1 == 1:
                _fix_lengths(lengths)
            elif at < bits:
                at, count = _read_lengths(words, bits, at, lengths, distances)
            literal_mask = _fill_table(lengths[:count], _OF_LITERAL, literals)
            distance_mask = _fill_table(lengths[count : count + _DISTANCES], _OF_DISTANCE, distances)
            at = _skip_symbols(words, bits, at, literals, literal_mask, distances, distance_mask)
        else:
            return 0, _INVALID
        if head & 1:
            return start, at
    return 0, _INVALID


@compiled(merged=True)
def _bits(words: Words, at: int) -> np.uint64:
    """The 64 bits from this bit on."""
    shift = np.uint64(at & 63)
    word: np.uint64 = words[at >> 6] >> shift | words[(at >> 6) + 1] << np.uint64(1) << np.uint64(63) - shift
    return word


@compiled(merged=True)
def _low(word: np.uint64, count: int) -> int:
    """The lowest bits of a word, so many, as a number that numba adds to others: uint64 + int64 are a float."""
    return np.int64(word & np.uint64((1 << count) - 1))  # type: ignore[return-value]


@compiled()
def _fix_lengths(lengths: Bytes) -> None:
    """The lengths of the fixed code: RFC 1951, section 3.2.6."""
    for k in range(_LITERALS):
        lengths[k] = 8 if k < 144 or k >= 280 else 9 if k < 256 else 7
    for k in range(_DISTANCES):
        lengths[_LITERALS + k] = 5


@compiled()
def _read_lengths(words: Words, bits: int, at: int, lengths: Bytes, table: Bytes) -> tuple[int, int]:
    """Read the lengths of a block's codes, itself coded. Returns the next bit, and the number of literals.

    RFC 1951, section 3.2.7. lengths (320,): first those of literals, then those of distances, then zeros.
    """
    head = _low(_bits(words, at), 14)
    at += 14
    count, total, used = 257 + (head & 31), 258 + (head & 31) + (head >> 5 & 31), 4 + (head >> 10)
    lengths[:] = 0
    if at >= bits:
        return _INVALID, count
    window = _bits(words, at)
    for k in range(used):
        lengths[_ORDER[k]] = window & np.uint64(7)
        window >>= np.uint64(3)
    at += 3 * used
    mask = _fill_table(lengths[:19], _OF_LENGTH, table)
    lengths[:] = 0
    filled = 0
    while filled < total and at < bits:
        window = _bits(words, at)
        entry = int(table[window & mask])
        at += entry & 7
        more = _low(window >> np.uint64(entry & 7), 7)
        length, times = entry >> 3, 1
        if length == 16:
            length, times, at = int(lengths[max(filled - 1, 0)]), 3 + (more & 3), at + 2
        elif length == 17:
            length, times, at = 0, 3 + (more & 7), at + 3
        elif length == 18:
            length, times, at = 0, 11 + more, at + 7
        for _ in range(min(times, total - filled)):
            lengths[filled] = length
            filled += 1
    return at, count


@compiled()
def _fill_table(lengths: Bytes, parts: Bytes, table: Bytes) -> np.uint64:
    """Fill the table of a code, given the length of each symbol's code. Returns the mask of the bits that select.

    The table doubles with each bit of length: the entries of shorter codes repeat, and those of this length are added.
    """
    longest = 0
    for symbol in range(len(lengths)):
        longest = max(longest, int(lengths[symbol]))
    table[0] = 0
    code = 0
    for length in range(1, longest + 1):
        half = 1 << length - 1
        for k in range(half):
            table[half + k] = table[k]
        code <<= 1
        for symbol in range(len(lengths)):
            if lengths[symbol] == length:
                backwards = 0
                for bit in range(length):
                    backwards |= (code >> bit & 1) << length - 1 - bit
                table[backwards] = length + parts[symbol]
                code += 1
    return np.uint64((1 << longest) - 1)


@compiled()
def _skip_symbols(
    words: Words,
    bits: int,
    at: int,
    literals: Bytes,
    literal_mask: np.uint64,
    distances: Bytes,
    distance_mask: np.uint64,
) -> int:
    """Return the bit after the symbol that ends the block."""
    while at < bits:
        window = _bits(words, at)
        entry = int(literals[window & literal_mask])
        if entry < _MATCH:
            if entry == 0:
                return _INVALID
            # A second symbol needs no further read: 15 bits, 20 of a length, and 15 that select a distance.
            at += entry
            window >>= np.uint64(entry)
            entry = int(literals[window & literal_mask])
            if entry < _MATCH:
                at += entry
                continue
        at += entry & _MATCH - 1
        if entry & _END:
            return at
        at += int(distances[window >> np.uint64(entry & _MATCH - 1) & distance_mask])
    return _INVALID
