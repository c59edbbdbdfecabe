"""How an OpenVDB file stores values, node behind node: nothing but reading tells where the next begins.

u8 code | inactive values, if the code says so | data: as they are, or i64 size and a zlib or blosc buffer,
                                                 or i64 -size and bytes that no codec made smaller

| code | what inactive voxels hold |
|---|---|
| 0, 1 | the background; minus the background |
| 2 | the one value that follows |
| 3 | minus the background, but where the mask that follows has a bit, the background |
| 4, 5 | the first value that follows, but where the mask behind has a bit the background; the second value |
| 6 | data are all values, not only those of active voxels |
"""

from __future__ import annotations

import struct
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake import memory
from nerfbake.errors import InvalidFile, Problem
from nerfbake.formats.wire.deflate import inflate
from nerfbake.formats.wire.openvdb_stream import ACTIVE_MASK, ALL_VALUES, BLOSC, PACKED, Stream
from nerfbake.formats.wire.vdb_held import Held, differs, joined
from nerfbake.kernels.arrays import Words
from nerfbake.kernels.maths.casting import cast
from nerfbake.kernels.parallel import over_chunks
from nerfbake.kernels.vdb.bitmask import bits_of, exclusive_sum, popcount, words_of

_CHUNK = 256  # leaves unpacked at a time by each core
# Of the codes: how many inactive values follow, and whether a mask that chooses among them.
_INACTIVE_VALUES = (0, 0, 1, 0, 1, 2, 0)
_SELECTION = (False, False, False, True, True, True, False)
_HEAD, _SIZE = struct.Struct("<64sB"), struct.Struct("<q")
Values = npt.NDArray[Any]


class Kind(NamedTuple):
    """What a grid's values are: channels, their type in the buffers, and that of backgrounds and inactive values."""

    channels: int
    dtype: np.dtype[Any]
    full: np.dtype[Any]

    @property
    def width(self) -> int:
        """Bytes of a value."""
        return self.channels * self.dtype.itemsize

    @property
    def held(self) -> np.dtype[Any]:
        """The type of values in memory: doubles are read as floats."""
        return np.dtype(np.float16 if self.dtype == np.float16 else np.float32)

    def beside(self, code: int, mask_size: int) -> int:
        """Bytes between a code and the data."""
        values = _INACTIVE_VALUES[code] * self.channels * self.full.itemsize
        return values + (mask_size if _SELECTION[code] else 0)

    def read(self, data: bytes | bytearray | memoryview, dtype: np.dtype[Any]) -> Values:
        """(q, c) in `held`."""
        values = np.frombuffer(data, dtype.newbyteorder("<")).reshape(-1, self.channels)
        return cast(values, self.held)


def require_code(code: int, what: str) -> None:
    if code > ALL_VALUES:
        raise InvalidFile(Problem(what, f"has a node stored in way {code}", f"0 to {ALL_VALUES}"))


# -- inner nodes -----------------------------------------------------------------------------------------------
def read_slots(
    stream: Stream, children: Words, active: Words, kind: Kind, flags: int, background: Values, what: str
) -> Held | None:
    """An inner node's tiles, children (w,) and active (w,) its masks; None where all of them are background."""
    (code,) = stream.numbers("B", what)
    require_code(code, what)
    beside = stream.take(kind.beside(code, 8 * len(active)), what)
    whole = code == ALL_VALUES or not flags & ACTIVE_MASK
    if code == 0 and not whole and not active.any():  # the rule, and there may be a hundred thousand of them
        _stored(stream, 0, kind, flags, what)
        return None
    active_bits = bits_of(active)
    count = len(active_bits) if whole else int(active_bits.sum())
    packed, size = _stored(stream, count, kind, flags, what), count * kind.width
    dense = np.empty((1, len(active_bits), kind.channels), kind.held)
    _fill_inactive(dense, [(0, code, bytes(beside))], kind, background)
    data = _unpacker(flags)(packed.view, size, what) if packed.smaller else packed.view
    dense[0, slice(None) if whole else active_bits] = kind.read(data, kind.dtype)
    own = (active_bits | differs(dense[0], background)) & ~bits_of(children)
    return Held(words_of(own), dense[0, own], active_bits[own]) if own.any() else None


class _Stored(NamedTuple):
    view: memoryview
    smaller: bool  # packed by a codec


def _stored(stream: Stream, count: int, kind: Kind, flags: int, what: str) -> _Stored:
    """What is stored for so many values."""
    size = count * kind.width
    # An empty array of halves has not even a size.
    if not flags & PACKED or (not count and kind.dtype == np.float16):
        return _Stored(stream.take(size, what), False)
    (stored,) = stream.numbers("q", what)
    if stored <= 0 and -stored != size:
        raise InvalidFile(Problem(what, f"has {-stored:,} bytes", f"{size:,}"))
    return _Stored(stream.take(abs(stored), what), stored > 0)


# -- leaves ----------------------------------------------------------------------------------------------------
def read_leaves(stream: Stream, masks: Words, kind: Kind, flags: int, background: Values, what: str) -> Held:
    """The leaves' voxels in the file's order; masks (l, 8) say which are active. Raises InvalidFile, MemoryLimit."""
    counts = popcount(masks)
    walk = _walk(stream, masks, kind, flags, what)
    most = int(counts.sum()) + sum(512 - int(counts[i]) for i, _, _ in walk.special)
    memory.hold(what, most * kind.channels * kind.held.itemsize)
    if not walk.special:
        values = np.empty((int(counts.sum()), kind.channels), kind.held)
        first = np.append(exclusive_sum(counts), len(values))

        def work(begin: int, end: int) -> None:
            values[first[begin] : first[end]] = _unpacked(stream.view, walk.pieces[begin:end], kind, flags, what)

        over_chunks(work, len(counts), _CHUNK)
        return Held(masks, values, np.ones(len(values), bool))
    return _read_special(stream.view, walk, masks, kind, flags, background, what)


class _Walk(NamedTuple):
    """Of each leaf where its data stand, their size, negative if they are not packed, and how many values they are;
    of those with inactive values that may not be the background: leaf, code, what stands beside the code."""

    pieces: list[tuple[int, int, int]]
    special: list[tuple[int, int, bytes]]


def _walk(stream: Stream, masks: Words, kind: Kind, flags: int, what: str) -> _Walk:
    """The one loop over leaves, kept bare: at 512^3 there are a hundred thousand."""
    counts, octets = popcount(masks).tolist(), masks.astype("<u8").tobytes()
    view, at, width = stream.view, stream.at, kind.width
    packed, all_held, no_empty_size = bool(flags & PACKED), not flags & ACTIVE_MASK, kind.dtype == np.float16
    besides = [kind.beside(code, 64) for code in range(ALL_VALUES + 1)]
    pieces, special = [], []
    try:
        for i, count in enumerate(counts):
            mask, code = _HEAD.unpack_from(view, at)
            if mask != octets[64 * i : 64 * i + 64]:
                raise InvalidFile(Problem(what, f"has two masks for leaf {i:,}", "the same one twice"))
            require_code(code, what)
            held = 512 if all_held or code == ALL_VALUES else count
            at += 65
            if code or all_held:
                special.append((i, ALL_VALUES if all_held else code, bytes(view[at : at + besides[code]])))
                at += besides[code]
            size = -held * width
            if packed and (held or not no_empty_size):
                (stored,) = _SIZE.unpack_from(view, at)
                if stored <= 0 and stored != size:
                    raise InvalidFile(Problem(what, f"has {-stored:,} bytes in leaf {i:,}", f"{-size:,}"))
                at, size = at + 8, stored
            pieces.append((at, size, held))
            at += abs(size)
    except (struct.error, OverflowError):
        at = len(view) + 1
    stream.at = at
    if at > len(view):
        found = f"ends within leaf {max(len(pieces) - 1, 0):,}"
        raise InvalidFile(Problem(what, found, f"the values of {len(counts):,} leaves"))
    return _Walk(pieces, special)


def _unpacked(view: memoryview, pieces: list[tuple[int, int, int]], kind: Kind, flags: int, what: str) -> Values:
    """(q, c) all that is stored of some leaves."""
    unpack = _unpacker(flags)
    data = b"".join(
        unpack(view[at : at + size], count * kind.width, what) if size > 0 else view[at : at - size]
        for at, size, count in pieces
    )
    return kind.read(data, kind.dtype)


def _read_special(
    view: memoryview, walk: _Walk, masks: Words, kind: Kind, flags: int, background: Values, what: str
) -> Held:
    """Leaves some of which say what their inactive voxels hold: each chunk becomes all its voxels for a while."""
    chunks: list[Any] = [None] * -(-len(masks) // _CHUNK)
    numbers = np.array([i for i, _, _ in walk.special])

    def work(begin: int, end: int) -> None:
        active, dense = bits_of(masks[begin:end]), np.empty((end - begin, 512, kind.channels), kind.held)
        own = walk.special[slice(*np.searchsorted(numbers, [begin, end]))]
        dense[:] = background
        _fill_inactive(dense, [(i - begin, code, beside) for i, code, beside in own], kind, background)
        stored = active.copy()
        stored[[i - begin for i, code, _ in own if code == ALL_VALUES]] = True
        dense[stored] = _unpacked(view, walk.pieces[begin:end], kind, flags, what)
        held = active | differs(dense, background)
        chunks[begin // _CHUNK] = Held(words_of(held), dense[held], active[held])

    over_chunks(work, len(masks), _CHUNK)
    return joined(chunks)


# -- inactive values -------------------------------------------------------------------------------------------
def _fill_inactive(dense: Values, nodes: list[tuple[int, int, bytes]], kind: Kind, background: Values) -> None:
    """Puts into dense (nodes, slots, c) what the inactive slots hold; nodes: row, code, what stands beside the code."""
    width = kind.channels * kind.full.itemsize
    for row, code, beside in nodes:
        values, mask = kind.read(beside[: _INACTIVE_VALUES[code] * width], kind.full), beside[-dense.shape[1] // 8 :]
        first = values[0] if len(values) else background if code in (0, ALL_VALUES) else -background
        dense[row] = first
        if _SELECTION[code]:
            chosen = np.unpackbits(np.frombuffer(mask, np.uint8), bitorder="little").view(bool)
            dense[row, chosen] = values[1] if len(values) > 1 else background


def _unpacker(flags: int) -> Any:
    if not flags & BLOSC:
        return inflate
    from nerfbake.formats.wire.blosc import unblosc  # only files of other programs need it

    return unblosc
