"""Decompress Blosc buffers, OpenVDB's default codec, to exactly the expected size.

u8 version | u8 codec's version | u8 flags | u8 type size | u32 size | u32 block size | u32 packed size | blocks
"""

from __future__ import annotations

import struct

import blosc

from nerfbake.errors import InvalidFile, Problem

MAX_INFLATION = 255  # limit of LZ4, the codec that OpenVDB and NanoVDB use in Blosc
_HEADER = struct.Struct("<4B3I")


def unblosc(packed: memoryview, size: int, what: str) -> bytes:
    """Return the `size` bytes of a buffer. Raises InvalidFile before allocation if it declares another size."""
    if len(packed) < _HEADER.size:
        raise InvalidFile(Problem(what, f"has a blosc buffer of {len(packed)} bytes", f"{_HEADER.size} or more"))
    *_, declared, _, stored = _HEADER.unpack_from(packed)
    if (declared, stored) != (size, len(packed)):
        found = f"declares {declared:,} bytes packed in {stored:,}"
        raise InvalidFile(Problem(what, found, f"{size:,} packed in {len(packed):,}"))
    if size > MAX_INFLATION * stored:
        raise InvalidFile(Problem(what, f"declares {size:,} bytes from {stored:,}", f"{MAX_INFLATION} times as many"))
    try:
        data: bytes = blosc.decompress(packed)
    except blosc.blosc_extension.error as error:
        raise InvalidFile(Problem(what, f"is damaged ({error})", "a whole blosc buffer")) from None
    return data
