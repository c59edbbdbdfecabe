"""NumPy's .npz archives, written so that the same arrays give the same bytes everywhere.

Members are dated 1980, and stored, or deflated as np.savez_compressed does it. Stored ones start at multiples of 64
bytes, so that a reader may map them:

    local header 30 B | name | extra: [zip64 20 B] + padding | .npy header and data
    ... | central directory | [zip64 end records] | end record 22 B

Sizes and CRCs stand in the local headers, not behind the data: cnpy, which volrend reads with, looks nowhere else.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterable, Iterator, Mapping
from itertools import chain
from math import prod
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from zlib_ng import zlib_ng

from nerfbake.formats.wire.blob import Rows, row_pieces
from nerfbake.formats.wire.deflate import deflate_raw
from nerfbake.formats.wire.npy import npy_head, npy_pieces

ALIGN = 64
_ZIP64_FROM = 0xFFFFFFFF  # numbers from here on do not fit the old fields, which then hold just this
_NO_SIZE = 0xFFFFFFFF  # says that the size stands in the zip64 field
_DEFLATED = 8
_DATE_1980 = 0x0021  # 1 January 1980 in DOS's bits
_UNIX, _MODE = 3 << 8, 0o100644 << 16


class Pieces(NamedTuple):
    """An array that need not be in memory as a whole; its rows are made twice, as the CRC stands before them."""

    rows: Rows


def write_npz(arrays: Mapping[str, npt.ArrayLike | Pieces], *, deflated: bool = False) -> Iterator[bytes | memoryview]:
    """The archive in pieces; stored arrays are handed over as they are, not copied."""
    directory, at = [], 0
    for key, value in arrays.items():
        name = f"{key}.npy".encode()
        head, size, pieces = _member(value)
        crc = zlib_ng.crc32(head)
        for piece in pieces():
            crc = zlib_ng.crc32(piece, crc)
        body = deflate_raw(chain([head], pieces())) if deflated else None
        packed = size if body is None else sum(map(len, body))
        zip64 = struct.pack("<HHQQ", 1, 16, size, packed) if max(size, packed) >= _ZIP64_FROM else b""
        version = 45 if zip64 else 20
        unpadded = at + 30 + len(name) + len(zip64) + 4
        padding = -unpadded % ALIGN
        extra = zip64 + struct.pack("<HH", 0xD935, padding) + bytes(padding)
        method = _DEFLATED if deflated else 0
        fields = (_NO_SIZE, _NO_SIZE) if zip64 else (packed, size)
        common = (0, method, 0, _DATE_1980, crc, *fields, len(name))
        yield struct.pack("<4s5H3I2H", b"PK\3\4", version, *common, len(extra)) + name + extra
        if body is None:
            yield head
            yield from pieces()
        else:
            yield from body
        directory.append(_central(name, version, common, (size, packed), at))
        at += 30 + len(name) + len(extra) + packed
    entries = b"".join(directory)
    yield entries + _end(len(directory), len(entries), at)


def _member(value: npt.ArrayLike | Pieces) -> tuple[bytes, int, Callable[[], Iterable[memoryview]]]:
    """An array's header, its size with that, and what gives the rest."""
    if isinstance(value, Pieces):
        rows = value.rows
        head = npy_head(rows.shape, rows.dtype)
        return head, len(head) + prod(rows.shape) * rows.dtype.itemsize, lambda: row_pieces(rows)
    head, body = npy_pieces(np.asarray(value))
    return head, len(head) + len(body), lambda: (body,)


def _central(name: bytes, version: int, common: tuple[int, ...], sizes: tuple[int, int], at: int) -> bytes:
    zip64 = b""
    if max(sizes) >= _ZIP64_FROM:
        zip64 += struct.pack("<QQ", *sizes)
    if at >= _ZIP64_FROM:
        zip64 += struct.pack("<Q", at)
    extra = struct.pack("<HH", 1, len(zip64)) + zip64 if zip64 else b""
    made_by = _UNIX | 45
    entry = struct.pack("<4s6H3I2H", b"PK\1\2", made_by, version, *common, len(extra))
    return entry + struct.pack("<3H2I", 0, 0, 0, _MODE, _u32(at)) + name + extra


def _end(count: int, size: int, at: int) -> bytes:
    zip64 = b""
    if at >= _ZIP64_FROM:
        zip64 = struct.pack("<4sQ2H2I4Q", b"PK\6\6", 44, 45, 45, 0, 0, count, count, size, at)
        zip64 += struct.pack("<4sIQI", b"PK\6\7", 0, at + size, 1)
    return zip64 + struct.pack("<4s4H2IH", b"PK\5\6", 0, 0, count, count, size, _u32(at), 0)


def _u32(number: int) -> int:
    return number if number < _ZIP64_FROM else _NO_SIZE
