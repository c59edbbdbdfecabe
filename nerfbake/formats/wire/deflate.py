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
_GZIP_BITS, _ZLIB_BITS = 31, 15  # zlib's window bits that stand for gzip and for zlib
_KINDS = {_GZIP_BITS: "gzip", _ZLIB_BITS: "zlib"}
_GZIP_HEAD = 1 << 12  # bytes: ten, and the name and comment of the packed file
_SLICE = 1 << 14  # bytes of a stream that are given to zlib-ng at once: it copies those that it does not use
_PIECE = 1 << 20  # bytes that are inflated before the next check of memory


def deflate(data: bytes | memoryview) -> bytes:
    """Compress short data to a zlib stream."""
    return bytes(libdeflate.zlib_compress(data, SHORT_LEVEL))


def deflate_whole(pieces: Iterable[bytes | memoryview]) -> bytes:
    """Compress pieces to one zlib stream with libdeflate, which needs all pieces in memory."""
    return bytes(libdeflate.zlib_compress(b"".join(pieces), WHOLE_LEVEL))


def deflate_best(data: bytes | memoryview) -> bytes:
    """Compress data to the smallest possible zlib stream."""
    return bytes(libdeflate.zlib_compress(data, BEST_LEVEL))


def gzip_whole(pieces: Iterable[bytes | memoryview]) -> bytes:
    """Compress pieces to one gzip stream without a time and a name, with libdeflate."""
    return bytes(libdeflate.gzip_compress(b"".join(pieces), WHOLE_LEVEL))


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


def gunzip_start(packed: memoryview, size: int, what: str) -> bytes:
    """Return the first `size` bytes of a gzip stream, or fewer if it has no more. Raises InvalidFile."""
    try:
        return zlib_ng.decompressobj(wbits=_GZIP_BITS).decompress(packed[: _GZIP_HEAD + 2 * size], size)
    except zlib_ng.error as error:  # type: ignore[misc]  # an exception, although its stub does not declare it so
        raise _damaged_stream(what, error, _GZIP_BITS) from None


def inflate_all(packed: memoryview, what: str, *, most: int | None = None) -> memoryview:
    """Like gunzip(), for a zlib stream, whose size is not known."""
    return _whole(packed, what, most, _ZLIB_BITS)


def gunzip(packed: memoryview, what: str, *, most: int | None = None) -> memoryview:
    """Return the content of all gzip streams in a file, read to their ends: the lengths and the CRC-32 are checked.

    The content is counted until the surrounding memory.scope() ends. most: its size at most. Raises InvalidFile if it
    has more, or is damaged or cut off, MemoryLimit.
    """
    return _whole(packed, what, most, _GZIP_BITS)


def _whole(packed: memoryview, what: str, most: int | None, bits: int) -> memoryview:
    out = bytearray()
    unpacker = zlib_ng.decompressobj(wbits=bits)
    at = 0
    while at < len(packed):
        if unpacker.eof:
            if not any(packed[at : at + 1]):  # zeros fill the last block of a tape or a device
                at += 1
                continue
            unpacker = zlib_ng.decompressobj(wbits=bits)
        piece = packed[at : at + _SLICE]
        at += len(piece)
        given: memoryview | bytes = piece
        while len(given):
            # A growing buffer over-allocates by an eighth.
            memory.require(what, _PIECE + len(out) // 8)
            try:
                data = unpacker.decompress(given, _PIECE)
            except zlib_ng.error as error:  # type: ignore[misc]  # as above
                raise _damaged_stream(what, error, bits) from None
            if most is not None and len(out) + len(data) > most:
                raise InvalidFile(
                    Problem(what, f"continues after {most:,} bytes", f"a {_KINDS[bits]} stream that ends there")
                )
            memory.hold(what, len(data))
            out += data
            given = unpacker.unconsumed_tail
        at -= len(unpacker.unused_data)
    if not unpacker.eof:
        raise InvalidFile(
            Problem(what, f"is cut off after {len(out):,} bytes of content", f"a whole {_KINDS[bits]} stream")
        )
    return memoryview(out).toreadonly()


def _damaged_stream(what: str, error: Exception, bits: int) -> InvalidFile:
    return InvalidFile(Problem(what, f"is damaged ({error})", f"a whole {_KINDS[bits]} stream"))


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
