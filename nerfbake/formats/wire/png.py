r"""Check the checksums of a PNG's pixels, which Pillow skips.

    \x89 P N G \r \n \x1a \n | chunks: u32 length, 4 bytes of type, data, u32 CRC-32 of type and data | IEND

Numbers are big endian.

Pillow checks the CRC of all other chunks. It stops inflating at the last row, so that it does not always reach the
Adler-32 of the stream: a texture with one flipped bit may be read with other texels.

Source: PNG (W3C, third edition), sections 5.3 and 5.4.
"""

from __future__ import annotations

import struct

import deflate

from nerfbake.errors import InvalidFile, Problem

SIGNATURE = b"\x89PNG\r\n\x1a\n"
_AROUND = 12  # bytes of a chunk's length, type and CRC
_PIXELS = (b"IDAT", b"fdAT")


def require_checksums(view: memoryview, name: str) -> None:
    """Raise InvalidFile if a chunk of pixels is incomplete, or has another CRC-32 than it declares."""
    at = len(SIGNATURE)
    while at + 8 <= len(view):
        size, kind = struct.unpack_from(">I4s", view, at)
        if kind in _PIXELS:
            if at + _AROUND + size > len(view):
                raise InvalidFile(Problem(name, f"ends within a chunk of pixels at byte {at:,}", "a whole PNG"))
            found = deflate.crc32(view[at + 4 : at + 8 + size])
            (stored,) = struct.unpack_from(">I", view, at + 8 + size)
            if found != stored:
                is_ = f"is damaged: its pixels at byte {at:,} have CRC-32 {found:08x}"
                raise InvalidFile(Problem(name, is_, f"{stored:08x}, as the file declares"))
        if kind == b"IEND":
            return
        at += _AROUND + size
