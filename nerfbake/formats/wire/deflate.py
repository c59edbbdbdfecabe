"""Compress zlib and deflate streams, and decompress them to exactly the expected size.

libdeflate compresses short streams, for example those of the leaves of a .vdb. On the chair's densities, 800 bytes a
leaf, it takes half the time of zlib-ng at level 2 and gives as many bytes; zlib-ng spends most of its time on its
start. zlib-ng compresses streams that arrive in pieces, which libdeflate does not support. Both give the same bytes on
every x86-64 processor: they select only checksums, comparisons and table moves by the processor's features, and these
have one result (tested under QEMU, from SSE2 to AVX2). libdeflate decompresses all streams, in two thirds of zlib-ng's
time.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable

import deflate as libdeflate
from zlib_ng import zlib_ng

from nerfbake import memory
from nerfbake.errors import InvalidFile, Problem

SHORT_LEVEL = 1  # libdeflate: on the chair's densities level 6 saves 2 % and takes a tenth to a third longer
WHOLE_LEVEL = 5  # libdeflate: on a fit's float16 rows 2 % larger than level 6, in 0.7 of its time; 3 % smaller than 4
BEST_LEVEL = 12  # libdeflate: on the chair's coefficients 8 % smaller than level 9, in 2 s
LEVEL = 2  # zlib-ng: on the chair's densities level 6 saves 0.6 % and takes 2.4 times as long, level 1 adds 31 %
MAX_INFLATION = 1032  # limit of deflate: 258 bytes for a quarter of a byte


def deflate(data: bytes | memoryview) -> bytes:
    """Compress short data to a zlib stream."""
    return bytes(libdeflate.zlib_compress(data, SHORT_LEVEL))


def deflate_whole(pieces: Iterable[bytes | memoryview]) -> bytes:
    """Compress pieces to one zlib stream with libdeflate, which needs all pieces in memory."""
    return bytes(libdeflate.zlib_compress(b"".join(pieces), WHOLE_LEVEL))


def deflate_best(data: bytes | memoryview) -> bytes:
    """Compress data to the smallest possible zlib stream."""
    return bytes(libdeflate.zlib_compress(data, BEST_LEVEL))


def deflate_all(pieces: Iterable[bytes | memoryview]) -> bytes:
    """Compress pieces to one zlib stream with zlib-ng, one piece at a time."""
    packer = zlib_ng.compressobj(LEVEL)
    packed = [packer.compress(piece) for piece in pieces]
    return b"".join([*packed, packer.flush()])


def deflate_raw(head: bytes, data: bytes | memoryview) -> list[bytes]:
    """Return a deflate stream without zlib's header and checksum, as in zip archives. The head is not compressed."""
    # A stored block, which is not the last one: its kind, its length, and the complement of the length.
    stored = struct.pack("<BHH", 0, len(head), len(head) ^ 0xFFFF) + head
    return [stored, bytes(libdeflate.deflate_compress(data, WHOLE_LEVEL))]


def inflate(packed: memoryview, size: int, what: str) -> bytes | bytearray:
    """Return the `size` bytes of a zlib stream. Raises InvalidFile if it has fewer or more, or is damaged."""
    if size > MAX_INFLATION * len(packed) + 64:
        found = f"declares {size:,} bytes from {len(packed):,}"
        raise InvalidFile(Problem(what, found, f"{MAX_INFLATION} times as many, deflate's bound"))
    try:
        data = libdeflate.zlib_decompress(packed, size)
    except libdeflate.DeflateError:
        return _diagnosed(packed, size, what)
    return data if len(data) == size else _diagnosed(packed, size, what)


def gunzip(packed: memoryview, most: int, what: str) -> bytes:
    """Return the first `most` bytes of a gzip stream, or all if it has fewer. Raises InvalidFile, MemoryLimit."""
    if most > MAX_INFLATION * len(packed) + 64:
        found = f"declares {most:,} bytes from {len(packed):,}"
        raise InvalidFile(Problem(what, found, f"{MAX_INFLATION} times as many, deflate's bound"))
    memory.require(what, most)
    try:
        return zlib_ng.decompressobj(wbits=31).decompress(packed, most)
    except zlib_ng.error as error:  # type: ignore[misc]  # an exception, although its stub does not declare it so
        raise InvalidFile(Problem(what, f"is damaged ({error})", "a whole gzip stream")) from None


def _diagnosed(packed: memoryview, size: int, what: str) -> bytes:
    """Decompress with zlib-ng, which reports the cause of an error."""
    unpacker = zlib_ng.decompressobj()
    try:
        data = unpacker.decompress(packed, size + 1)
    except zlib_ng.error as error:  # type: ignore[misc]  # an exception, although its stub does not declare it so
        raise InvalidFile(Problem(what, f"is damaged ({error})", "a whole zlib stream")) from None
    if len(data) != size or not unpacker.eof:
        more = "more than " if len(data) > size else ""
        raise InvalidFile(Problem(what, f"inflates to {more}{min(len(data), size):,} bytes", f"{size:,} exactly"))
    return data
