"""Zstandard around any format (.zst): the same octree gives the same bytes, and nothing inflates beyond a limit."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import zstandard

from nerfbake.errors import InvalidFile, MemoryLimit, Problem

LEVEL = 3
MAX_WINDOW = 1 << 27  # what zstd's own command line allows
_CHUNK = 1 << 20
# A block of 4 bytes may inflate to 128 KiB: so many bytes are at most 32 MiB before they are counted.
_SIP = 1 << 10


def compress(pieces: Iterable[bytes | memoryview]) -> Iterator[bytes]:
    """One frame with a checksum, on one thread: more threads would cut it elsewhere."""
    compressor = zstandard.ZstdCompressor(level=LEVEL, write_checksum=True).compressobj()
    for piece in pieces:
        for start in range(0, len(piece), _CHUNK):
            if packed := compressor.compress(piece[start : start + _CHUNK]):
                yield packed
    yield compressor.flush()


def decompress(view: memoryview, *, max_memory: int) -> memoryview:
    """All frames, one after the other. Raises MemoryLimit before more than max_memory is held."""
    out, at = bytearray(), 0
    context = zstandard.ZstdDecompressor(max_window_size=MAX_WINDOW)
    while at < len(view):
        frame = context.decompressobj()
        while not frame.eof:
            if at == len(view):
                raise InvalidFile(Problem("zstd frame", f"does not end by byte {at:,}", "a whole frame"))
            sip = view[at : at + _SIP]
            try:
                out += frame.decompress(sip)
            except zstandard.ZstdError as error:
                raise InvalidFile(Problem(f"zstd frame near byte {at:,}", f"is damaged ({error})", "zstd")) from None
            at += len(sip) - len(frame.unused_data)
            if len(out) > max_memory:
                raise MemoryLimit("the decompressed file", len(out), max_memory)
    return memoryview(out).toreadonly()
