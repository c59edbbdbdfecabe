"""Compress zlib and deflate streams, and decompress them to exactly the expected size.

libdeflate compresses short streams, for example those of the leaves of a .vdb. On the chair's densities, 800 bytes a
leaf, it takes half the time of zlib-ng at level 2 and gives as many bytes; zlib-ng spends most of its time on its
start. zlib-ng compresses streams that arrive in pieces, which libdeflate does not support. Both give the same bytes on
every x86-64 processor: they select only checksums, comparisons and table moves by the processor's features, and these
have one result (tested under QEMU, from SSE2 to AVX2). libdeflate decompresses all streams, in two thirds of zlib-ng's
time.

A stream of 16 MiB or more is made of parts that libdeflate compresses at the same time; kernels.coding.deflate_blocks
joins them. They do not depend on the number of threads. On a fit's float16 rows the stream has 1.001 times the bytes of
one that is compressed as a whole. To find the last block of a part takes 0.15 of the time in which libdeflate
compresses it. zlib-ng can end a part with a byte by itself: at level 5 with 1.009 times the bytes in 1.36 times the
time, at level 6 with 0.999 times the bytes in 2.7 times the time.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from itertools import chain, islice

import deflate as libdeflate
from zlib_ng import zlib_ng

from nerfbake import memory
from nerfbake.errors import InvalidFile, Problem
from nerfbake.kernels.parallel import in_order

SHORT_LEVEL = 1  # libdeflate: on the chair's densities level 6 saves 2 % and takes a tenth to a third longer
WHOLE_LEVEL = 5  # libdeflate: on a fit's float16 rows 2 % larger than level 6, in 0.7 of its time; 3 % smaller than 4
BEST_LEVEL = 12  # libdeflate: on the chair's coefficients 8 % smaller than level 9, in 2 s
LEVEL = 2  # zlib-ng: on the chair's densities level 6 saves 0.6 % and takes 2.4 times as long, level 1 adds 31 %
MAX_INFLATION = 1032  # limit of deflate: 258 bytes for a quarter of a byte
_PART = 1 << 20  # bytes of a part of a stream: as few as add 0.1 % to the stream
_PARTS = 16  # a stream of fewer parts is compressed as a whole, in 0.1 s: to load numba alone takes 0.3 s
_ZLIB_HEADER = b"\x78\x5e"  # a window of 32 KiB, a fast level; both headers are those that libdeflate writes
_GZIP_HEADER = b"\x1f\x8b\x08" + bytes(6) + b"\xff"  # no name, no time, unknown system
_GZIP_BITS, _ZLIB_BITS = 31, 15  # zlib's window bits that stand for gzip and for zlib
_KINDS = {_GZIP_BITS: "gzip", _ZLIB_BITS: "zlib"}
_MOST_HEADER = 1 << 12  # bytes of gzip's: ten, and the name and comment of the packed file
_SLICE = 1 << 14  # bytes of a stream that are given to zlib-ng at once: it copies those that it does not use
_PIECE = 1 << 20  # bytes that are inflated before the next check of memory


def deflate(data: bytes | memoryview) -> bytes:
    """Compress short data to a zlib stream."""
    return bytes(libdeflate.zlib_compress(data, SHORT_LEVEL))


def deflate_whole(pieces: Iterable[bytes | memoryview]) -> bytes:
    """Compress pieces to one zlib stream with libdeflate, on every core."""
    checked = _Checked(pieces, zlib_ng.adler32, 1)
    return b"".join([_ZLIB_HEADER, *_stream(checked), struct.pack(">I", checked.sum)])


def deflate_best(data: bytes | memoryview) -> bytes:
    """Compress data to the smallest possible zlib stream."""
    return bytes(libdeflate.zlib_compress(data, BEST_LEVEL))


def gzip_whole(pieces: Iterable[bytes | memoryview]) -> bytes:
    """Compress pieces to one gzip stream without a time and a name, with libdeflate, on every core."""
    checked = _Checked(pieces, zlib_ng.crc32, 0)
    return b"".join([_GZIP_HEADER, *_stream(checked), struct.pack("<II", checked.sum, checked.size & 0xFFFFFFFF)])


def deflate_all(pieces: Iterable[bytes | memoryview]) -> bytes:
    """Compress pieces to one zlib stream with zlib-ng, one piece at a time."""
    packer = zlib_ng.compressobj(LEVEL)
    packed = [packer.compress(piece) for piece in pieces]
    return b"".join([*packed, packer.flush()])


def deflate_raw(head: bytes, pieces: Iterable[bytes | memoryview]) -> list[bytes | memoryview]:
    """Return a deflate stream without zlib's header and checksum, as in zip archives, in parts.

    The head is not compressed; the pieces are, with libdeflate, on every core.
    """
    # A stored block, which is not the last one: its kind, its length, and the complement of the length.
    return [struct.pack("<BHH", 0, len(head), len(head) ^ 0xFFFF) + head, *_stream(pieces)]


class _Checked:
    """Pieces, their checksum and their size: those of the pieces that were taken."""

    def __init__(
        self, pieces: Iterable[bytes | memoryview], check: Callable[[bytes | memoryview, int], int], start: int
    ) -> None:
        self._pieces, self._check = pieces, check
        self.sum, self.size = start, 0

    def __iter__(self) -> Iterator[bytes | memoryview]:
        for piece in self._pieces:
            self.sum, self.size = self._check(piece, self.sum), self.size + len(piece)
            yield piece


def _stream(pieces: Iterable[bytes | memoryview]) -> Iterator[bytes | memoryview]:
    """Yield a deflate stream in parts. The first 16 MiB of the pieces are held, and then a part for each core."""
    parts = _parts(pieces)
    first = list(islice(parts, _PARTS))
    if len(first) < _PARTS:
        yield _ended(first[0] if len(first) == 1 else b"".join(first))
    else:
        yield from in_order(_works(chain(first, parts)))


def _works(parts: Iterator[bytes | memoryview]) -> Iterator[Callable[[], bytes | memoryview]]:
    from nerfbake.kernels.coding.deflate_blocks import continued  # imports numba, which most files do not need

    def followed(part: bytes | memoryview) -> memoryview:
        return continued(_ended(part))

    part = next(parts)
    for following in parts:
        yield partial(followed, part)
        part = following
    yield partial(_ended, part)


def _ended(part: bytes | memoryview) -> bytes:
    return bytes(libdeflate.deflate_compress(part, WHOLE_LEVEL))


def _parts(pieces: Iterable[bytes | memoryview]) -> Iterator[bytes | memoryview]:
    """Yield the same bytes in parts of one size, the last one of at most this size; slices of large pieces."""
    rest, size = list[memoryview](), 0
    for given in pieces:
        piece, begin = memoryview(given), 0
        while size + len(piece) - begin >= _PART:
            end = begin + _PART - size
            yield b"".join([*rest, piece[begin:end]]) if rest else piece[begin:end]
            rest, size, begin = [], 0, end
        if begin < len(piece):
            rest.append(piece[begin:])
            size += len(piece) - begin
    if size:
        yield rest[0] if len(rest) == 1 else b"".join(rest)


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
        return zlib_ng.decompressobj(wbits=_GZIP_BITS).decompress(packed[: _MOST_HEADER + 2 * size], size)
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
