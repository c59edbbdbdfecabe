"""zlib streams as VDB files hold them: packed whole, unpacked to the size they must have and not a byte more.

Short streams, of which a .vdb has one for each leaf, are packed by libdeflate: on the chair's densities, 800 bytes a
leaf, it takes half the time of zlib-ng at level 2 for as many bytes, since most of that is zlib-ng's start. Long ones
come in pieces, which libdeflate does not take. Both give the same bytes on every x86-64 processor: what they choose by
its features are checksums, and comparisons and table moves that have one result (seen under QEMU, from SSE2 to AVX2).
libdeflate unpacks them all, in two thirds of the time.
"""

from __future__ import annotations

from collections.abc import Iterable

import deflate as libdeflate
from zlib_ng import zlib_ng

from nerfbake.errors import InvalidFile, Problem

SHORT_LEVEL = 1  # of libdeflate: on the chair's densities level 6 saves 2 % and takes a tenth to a third longer
WHOLE_LEVEL = 5  # of libdeflate: on the chair's float16 rows 1.6 % below zlib-ng's level 2, in 0.8 of its time
BEST_LEVEL = 12  # of libdeflate: on the chair's coefficients 8 % below level 9, in 2 s
LEVEL = 2  # of zlib-ng: on the chair's densities level 6 saves 0.6 % and takes 2.4 times as long, level 1 costs 31 %
MAX_INFLATION = 1032  # deflate's own bound: 258 bytes for a quarter of a byte


def deflate(data: bytes | memoryview) -> bytes:
    """A zlib stream."""
    return bytes(libdeflate.zlib_compress(data, SHORT_LEVEL))


def deflate_whole(pieces: Iterable[bytes | memoryview]) -> bytes:
    """One zlib stream of all the pieces, which are held beside it."""
    return bytes(libdeflate.zlib_compress(b"".join(pieces), WHOLE_LEVEL))


def deflate_best(data: bytes | memoryview) -> bytes:
    """A zlib stream, as small as can be."""
    return bytes(libdeflate.zlib_compress(data, BEST_LEVEL))


def deflate_all(pieces: Iterable[bytes | memoryview]) -> bytes:
    """One zlib stream of all the pieces."""
    packer = zlib_ng.compressobj(LEVEL)
    packed = [packer.compress(piece) for piece in pieces]
    return b"".join([*packed, packer.flush()])


def deflate_raw(pieces: Iterable[bytes | memoryview]) -> list[bytes]:
    """One stream of all the pieces without zlib's header and checksum, as archives hold it."""
    packer = zlib_ng.compressobj(LEVEL, wbits=-15)
    return [*(packer.compress(piece) for piece in pieces), packer.flush()]


def inflate(packed: memoryview, size: int, what: str) -> bytes | bytearray:
    """The `size` bytes of a zlib stream. Raises InvalidFile if it holds fewer or more, or is damaged."""
    if size > MAX_INFLATION * len(packed) + 64:
        found = f"declares {size:,} bytes from {len(packed):,}"
        raise InvalidFile(Problem(what, found, f"{MAX_INFLATION} times as many, deflate's bound"))
    try:
        data = libdeflate.zlib_decompress(packed, size)
    except libdeflate.DeflateError:
        return _told(packed, size, what)
    return data if len(data) == size else _told(packed, size, what)


def _told(packed: memoryview, size: int, what: str) -> bytes:
    """The same, byte after byte, by a reader that says what is wrong."""
    unpacker = zlib_ng.decompressobj()
    try:
        data = unpacker.decompress(packed, size + 1)
    except zlib_ng.error as error:  # type: ignore[misc]  # an exception, though its stub does not say so
        raise InvalidFile(Problem(what, f"is damaged ({error})", "a whole zlib stream")) from None
    if len(data) != size or not unpacker.eof:
        more = "more than " if len(data) > size else ""
        raise InvalidFile(Problem(what, f"inflates to {more}{min(len(data), size):,} bytes", f"{size:,}, all of it"))
    return data
