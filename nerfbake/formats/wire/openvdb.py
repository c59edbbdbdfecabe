"""Read the elements of OpenVDB files: numbers, text, metadata, and the values of nodes.

A file has no table of offsets: the position of an element is known only after reading all elements before it. The
values of a node:

u8 code | inactive values, depending on the code | data: uncompressed, or i64 size and a zlib or blosc buffer,
                                                   or i64 -size and bytes that no codec made smaller

| code | value of inactive voxels |
|---|---|
| 0, 1 | the background; minus the background |
| 2 | the single value that follows |
| 3 | where the mask that follows has a bit, the background; elsewhere minus the background |
| 4, 5 | where the mask after the values has a bit, the background (4) or the second value (5); elsewhere the first |
| 6 | the data contain all values, not only those of active voxels |
"""

from __future__ import annotations

import struct
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake import memory
from nerfbake.errors import InvalidFile, Problem
from nerfbake.formats.wire.deflate import inflate
from nerfbake.formats.wire.vdb_values import StoredValues, concatenate, differs_from_background
from nerfbake.kernels.arrays import Words
from nerfbake.kernels.maths.elementary import cast
from nerfbake.kernels.parallel import over_chunks
from nerfbake.kernels.vdb.bitmask import bits_of, exclusive_sum, popcount, words_of

MAGIC, VERSION = 0x56444220, 224
UUID = b"00000000-0000-0000-0000-000000000000"
ZIP, ACTIVE_MASK, BLOSC = 1, 2, 4  # compression flags of a grid
PACKED = ZIP | BLOSC  # if a grid has both flags, it uses blosc
ACTIVE_ONLY, ALL_VALUES = 0, 6  # codes before a node's values
MAX_TEXT = 1 << 20
MAX_ENTRIES = 10_000


def text(value: str | bytes) -> bytes:
    raw = value if isinstance(value, bytes) else value.encode()
    return struct.pack("<I", len(raw)) + raw


class Stream:
    """A sequential reader of a file."""

    def __init__(self, view: memoryview) -> None:
        self.view, self.at = view, 0

    def take(self, size: int, what: str) -> memoryview:
        """Return the next `size` bytes. Raises InvalidFile if there are fewer."""
        end = self.at + size
        if size < 0 or end > len(self.view):
            found = f"would be at bytes {self.at:,} to {end:,}"
            raise InvalidFile(Problem(what, found, f"up to {len(self.view):,}, the file's end"))
        piece = self.view[self.at : end]
        self.at = end
        return piece

    def numbers(self, layout: str, what: str) -> tuple[Any, ...]:
        return struct.unpack("<" + layout, self.take(struct.calcsize("<" + layout), what))

    def array(self, dtype: str, count: int, what: str) -> npt.NDArray[Any]:
        kind = np.dtype(dtype)
        return np.frombuffer(self.take(count * kind.itemsize, what), kind)

    def text(self, what: str) -> str:
        (size,) = self.numbers("I", what)
        if size > MAX_TEXT:
            raise InvalidFile(Problem(what, f"has {size:,} bytes", f"{MAX_TEXT:,} at most"))
        return bytes(self.take(size, what)).decode("utf-8", "replace")

    def metadata(self) -> dict[str, memoryview]:
        """Return raw values by name, whatever their types. OpenVDB lists the leaves of a grid in one of any size."""
        (count,) = self.numbers("I", "metadata")
        if count > MAX_ENTRIES:
            raise InvalidFile(Problem("metadata", f"has {count:,} entries", f"{MAX_ENTRIES:,} at most"))
        entries = {}
        for _ in range(count):
            name, _ = self.text("metadata"), self.text("metadata")
            what = f"metadata {name[:40]!r}"
            (size,) = self.numbers("I", what)
            entries[name] = self.take(size, what)
        return entries


_CHUNK = 256  # leaves that a core unpacks at a time
# For each code: the number of inactive values that follow, and whether a mask selects between two.
_INACTIVE_VALUES = (0, 0, 1, 0, 1, 2, 0)
_SELECTION = (False, False, False, True, True, True, False)
_HEAD, _SIZE = struct.Struct("<64sB"), struct.Struct("<q")
Values = npt.NDArray[Any]


class ValueType(NamedTuple):
    """A grid's values: channels, dtype in the buffers, and dtype of the background and of inactive values (`full`)."""

    channels: int
    dtype: np.dtype[Any]
    full: np.dtype[Any]

    @property
    def width(self) -> int:
        """Bytes of a value."""
        return self.channels * self.dtype.itemsize

    @property
    def held(self) -> np.dtype[Any]:
        """The dtype in memory: doubles are converted to float32."""
        return np.dtype(np.float16 if self.dtype == np.float16 else np.float32)

    def beside(self, code: int, mask_size: int) -> int:
        """The number of bytes between a code and the data."""
        values = _INACTIVE_VALUES[code] * self.channels * self.full.itemsize
        return values + (mask_size if _SELECTION[code] else 0)

    def read(self, data: bytes | bytearray | memoryview, dtype: np.dtype[Any]) -> Values:
        """Convert bytes of this dtype to values (q, c) of the dtype `held`."""
        values = np.frombuffer(data, dtype.newbyteorder("<")).reshape(-1, self.channels)
        return cast(values, self.held)


def require_code(code: int, what: str) -> None:
    if code > ALL_VALUES:
        raise InvalidFile(Problem(what, f"has a node with code {code}", f"0 to {ALL_VALUES}"))


# -- inner nodes -----------------------------------------------------------------------------------------------
def read_slots(
    stream: Stream, children: Words, active: Words, kind: ValueType, flags: int, background: Values, what: str
) -> StoredValues | None:
    """Read the tiles of an inner node with the masks children (w,) and active (w,).

    Returns None if all tiles are inactive background.
    """
    (code,) = stream.numbers("B", what)
    require_code(code, what)
    beside = stream.take(kind.beside(code, 8 * len(active)), what)
    whole = code == ALL_VALUES or not flags & ACTIVE_MASK
    if code == 0 and not whole and not active.any():  # the usual case; a file can have a hundred thousand such nodes
        _stored(stream, 0, kind, flags, what)
        return None
    active_bits = bits_of(active)
    count = len(active_bits) if whole else int(active_bits.sum())
    packed, size = _stored(stream, count, kind, flags, what), count * kind.width
    dense = np.empty((1, len(active_bits), kind.channels), kind.held)
    _fill_inactive(dense, [(0, code, bytes(beside))], kind, background)
    data = _unpacker(flags)(packed.view, size, what) if packed.smaller else packed.view
    dense[0, slice(None) if whole else active_bits] = kind.read(data, kind.dtype)
    own = (active_bits | differs_from_background(dense[0], background)) & ~bits_of(children)
    return StoredValues(words_of(own), dense[0, own], active_bits[own]) if own.any() else None


class _Stored(NamedTuple):
    view: memoryview
    smaller: bool  # packed by a codec


def _stored(stream: Stream, count: int, kind: ValueType, flags: int, what: str) -> _Stored:
    """Read the stored bytes of `count` values."""
    size = count * kind.width
    # For an empty array of float16 no size is stored.
    if not flags & PACKED or (not count and kind.dtype == np.float16):
        return _Stored(stream.take(size, what), False)
    (stored,) = stream.numbers("q", what)
    if stored <= 0 and -stored != size:
        raise InvalidFile(Problem(what, f"has {-stored:,} bytes", f"{size:,}"))
    return _Stored(stream.take(abs(stored), what), stored > 0)


# -- leaves ----------------------------------------------------------------------------------------------------
def read_leaves(
    stream: Stream, masks: Words, kind: ValueType, flags: int, background: Values, what: str
) -> StoredValues:
    """Read the leaves' voxels in the file's order; masks (l, 8) mark active ones. Raises InvalidFile, MemoryLimit."""
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
        return StoredValues(masks, values, np.ones(len(values), bool))
    return _read_special(stream.view, walk, masks, kind, flags, background, what)


class _Walk(NamedTuple):
    """The positions of the leaves' data.

    pieces: for each leaf the offset of its data, their size (negative if they are not compressed), and the number of
    values. special: leaf, code and the bytes between code and data, for leaves whose inactive values can differ from
    the background.
    """

    pieces: list[tuple[int, int, int]]
    special: list[tuple[int, int, bytes]]


def _walk(stream: Stream, masks: Words, kind: ValueType, flags: int, what: str) -> _Walk:
    """Find the data of all leaves. The only Python loop over leaves, kept minimal: 512^3 has a hundred thousand."""
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


def _unpacked(view: memoryview, pieces: list[tuple[int, int, int]], kind: ValueType, flags: int, what: str) -> Values:
    """Return all stored values of some leaves, (q, c)."""
    unpack = _unpacker(flags)
    data = b"".join(
        unpack(view[at : at + size], count * kind.width, what) if size > 0 else view[at : at - size]
        for at, size, count in pieces
    )
    return kind.read(data, kind.dtype)


def _read_special(
    view: memoryview, walk: _Walk, masks: Words, kind: ValueType, flags: int, background: Values, what: str
) -> StoredValues:
    """Read leaves of which some store inactive values. Each chunk is temporarily expanded to all its voxels."""
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
        held = active | differs_from_background(dense, background)
        chunks[begin // _CHUNK] = StoredValues(words_of(held), dense[held], active[held])

    over_chunks(work, len(masks), _CHUNK)
    return concatenate(chunks)


# -- inactive values -------------------------------------------------------------------------------------------
def _fill_inactive(dense: Values, nodes: list[tuple[int, int, bytes]], kind: ValueType, background: Values) -> None:
    """Write the inactive values into dense (nodes, slots, c).

    nodes: row in dense, code, and the bytes between code and data.
    """
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
    from nerfbake.formats.wire.blosc import unblosc  # only files of other programs use blosc

    return unblosc
