"""Zstandard around any format (.zst): the same octree gives the same bytes, and nothing inflates beyond a limit."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import zstandard

from nerfbake import memory
from nerfbake.errors import InvalidFile, Problem

LEVEL = 3
MAX_WINDOW = 1 << 27  # what zstd's own command line allows
_CHUNK = 1 << 20
# A block of 4 bytes may inflate to 128 KiB: so many bytes are at most 32 MiB before they are counted.
_SIP = 1 << 10
_HEAD = 18  # bytes of the longest frame header
_SKIPPED = range(0x184D2A50, 0x184D2A60)  # magic numbers of frames that hold no content


def compress(pieces: Iterable[bytes | memoryview]) -> Iterator[bytes]:
    """One frame with a checksum, on one thread: more threads would cut it elsewhere."""
    compressor = zstandard.ZstdCompressor(level=LEVEL, write_checksum=True).compressobj()
    for piece in pieces:
        for start in range(0, len(piece), _CHUNK):
            if packed := compressor.compress(piece[start : start + _CHUNK]):
                yield packed
    yield compressor.flush()


def decompress(view: memoryview) -> memoryview:
    """All frames, one after the other. Raises InvalidFile, MemoryLimit before more is held than is allowed."""
    out, at = bytearray(), 0
    context = zstandard.ZstdDecompressor(max_window_size=MAX_WINDOW)
    while at < len(view):
        frame = context.decompressobj()
        window, size = _declared(view[at : at + _HEAD], at)
        memory.require("the decompressed file", size)
        memory.require("zstd's window", min(window, MAX_WINDOW))
        while not frame.eof:
            if at == len(view):
                raise InvalidFile(Problem("zstd frame", f"does not end by byte {at:,}", "a whole frame"))
            sip = view[at : at + _SIP]
            try:
                piece = frame.decompress(sip)
            except zstandard.ZstdError as error:
                raise InvalidFile(Problem(f"zstd frame near byte {at:,}", f"is damaged ({error})", "zstd")) from None
            at += len(sip) - len(frame.unused_data)
            # A growing buffer has an eighth to spare.
            memory.require("the decompressed file", len(piece) + len(out) // 8)
            memory.hold("the decompressed file", len(piece))
            out += piece
    return memoryview(out).toreadonly()


def _declared(head: memoryview, at: int) -> tuple[int, int]:
    """Window and content of a frame in bytes, as its header says; 0 for a content that it does not say."""
    if int.from_bytes(head[:4], "little") in _SKIPPED:
        return 0, 0
    try:
        found = zstandard.get_frame_parameters(head)
    except zstandard.ZstdError as error:
        raise InvalidFile(Problem(f"zstd frame at byte {at:,}", f"is damaged ({error})", "zstd")) from None
    size = found.content_size
    return found.window_size, 0 if size == zstandard.CONTENTSIZE_UNKNOWN else size
