"""How an OpenVDB file stores values, node behind node: nothing but reading tells where the next begins.

mask | u8 code | inactive values, if the code says so | data: as they are, or i64 size and a zlib or blosc buffer,
                                                              or i64 -size and bytes that no codec made smaller
"""

from __future__ import annotations

import struct
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake.errors import InvalidFile, Problem
from nerfbake.formats._deflate import inflate
from nerfbake.formats._openvdb_stream import ACTIVE_MASK, ALL_VALUES, BLOSC, PACKED, Stream
from nerfbake.kernels.bitmask import Words, exclusive_sum, popcount
from nerfbake.kernels.parallel import over_chunks

_CHUNK = 256  # leaves unpacked at a time by each core
# Of the codes: how many inactive values follow, and whether a mask that chooses among them.
_INACTIVE_VALUES = (0, 0, 1, 0, 1, 2, 0)
_SELECTION = (False, False, False, True, True, True, False)
_HEAD, _SIZE = struct.Struct("<64sB"), struct.Struct("<q")


class Kind(NamedTuple):
    """What a grid's values are."""

    channels: int
    dtype: np.dtype[Any]

    @property
    def width(self) -> int:
        """Bytes of a value."""
        return self.channels * self.dtype.itemsize

    def beside(self, code: int, mask_size: int) -> int:
        """Bytes between a code and the data."""
        return _INACTIVE_VALUES[code] * self.width + (mask_size if _SELECTION[code] else 0)


def require_code(code: int, what: str) -> None:
    if code > ALL_VALUES:
        raise InvalidFile(Problem(what, f"has a node stored in way {code}", f"0 to {ALL_VALUES}"))


def read_leaves(stream: Stream, masks: Words, kind: Kind, flags: int, what: str) -> npt.NDArray[Any]:
    """(m, c) the active voxels' values, leaves in the file's order."""
    counts = popcount(masks)
    first = np.append(exclusive_sum(counts), counts.sum())
    pieces = _walk(stream, masks, kind, flags, what)
    held = np.array([count for _, _, count in pieces], np.int64)
    view, width, unpack = stream.view, kind.width, _unpacker(flags)
    values = np.empty((int(first[-1]), kind.channels), kind.dtype)

    def work(begin: int, end: int) -> None:
        data = b"".join(
            unpack(view[at : at + size], count * width, what) if size > 0 else view[at : at - size]
            for at, size, count in pieces[begin:end]
        )
        part = np.frombuffer(data, kind.dtype.newbyteorder("<")).reshape(-1, kind.channels)
        if len(part) > first[end] - first[begin]:
            # Leaves that are stored whole: their active values are wanted.
            wanted = np.ones(len(part), bool)
            whole = np.flatnonzero(held[begin:end] == 512)
            octets = masks[begin + whole].astype("<u8").view(np.uint8)
            starts = exclusive_sum(held[begin:end])[whole]
            wanted[starts[:, None] + np.arange(512)] = np.unpackbits(octets, axis=1, bitorder="little")
            part = part[wanted]
        values[first[begin] : first[end]] = part

    over_chunks(work, len(pieces), _CHUNK)
    return values


def _walk(stream: Stream, masks: Words, kind: Kind, flags: int, what: str) -> list[tuple[int, int, int]]:
    """Of each leaf where its data stand, their size, negative if they are not packed, and how many values they are.

    The one loop over leaves, kept bare: at 512^3 there are a hundred thousand.
    """
    counts, octets = popcount(masks).tolist(), masks.astype("<u8").tobytes()
    view, at, width = stream.view, stream.at, kind.width
    packed, all_held, no_empty_size = bool(flags & PACKED), not flags & ACTIVE_MASK, kind.dtype == np.float16
    beside = [kind.beside(code, 64) for code in range(ALL_VALUES + 1)]
    pieces = []
    try:
        for i, count in enumerate(counts):
            mask, code = _HEAD.unpack_from(view, at)
            if mask != octets[64 * i : 64 * i + 64]:
                raise InvalidFile(Problem(what, f"has two masks for leaf {i:,}", "the same one twice"))
            require_code(code, what)
            held = 512 if all_held or code == ALL_VALUES else count
            at += 65 + beside[code]
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
    return pieces


def _unpacker(flags: int) -> Any:
    if not flags & BLOSC:
        return inflate
    from nerfbake.formats._blosc import unblosc  # only files of other programs need it

    return unblosc
