"""Zstandard around any format (.zst): the same octree gives the same bytes, and nothing inflates beyond a limit."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import NamedTuple

import zstandard

from nerfbake import memory
from nerfbake.errors import InvalidFile, Problem

LEVEL = 3
MAX_WINDOW = 1 << 27  # what zstd's own command line allows
_CHUNK = 1 << 20
# A block of 4 bytes may inflate to 128 KiB: so many bytes are at most 32 MiB before they are counted.
_SIP = 1 << 10
_HEAD = 18  # bytes of the longest frame header
_REPEATED = 1  # the kind of a block that is one byte over and over
_MOST_BLOCKS = 100_000
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
    frames = list(_frames(view))
    memory.require("the decompressed file", sum(frame.size for frame in frames))
    memory.require("zstd's window", min(max((frame.window for frame in frames), default=0), MAX_WINDOW))
    out, at = bytearray(), 0
    context = zstandard.ZstdDecompressor(max_window_size=MAX_WINDOW)
    while at < len(view):
        frame = context.decompressobj()
        while not frame.eof:
            if at == len(view):
                raise _unended(at)
            sip = view[at : at + _SIP]
            try:
                piece = frame.decompress(sip)
            except zstandard.ZstdError as error:
                raise _damaged(at, error) from None
            at += len(sip) - len(frame.unused_data)
            # A growing buffer has an eighth to spare.
            memory.require("the decompressed file", len(piece) + len(out) // 8)
            memory.hold("the decompressed file", len(piece))
            out += piece
    return memoryview(out).toreadonly()


class _Frame(NamedTuple):
    """What a frame says of itself, in bytes."""

    window: int
    size: int  # of its content; 0 where it does not say


def _frames(view: memoryview) -> Iterator[_Frame]:
    """The frames, found by their blocks' sizes alone: so a bomb is known before anything of it is unpacked.

    Of a file with more blocks than anybody's 12 GiB take the rest is left out: going through them would be slow.
    """
    at = blocks = 0
    while at < len(view) and blocks < _MOST_BLOCKS:
        head = view[at : at + _HEAD]
        if int.from_bytes(head[:4], "little") in _SKIPPED:
            at += 8 + int.from_bytes(head[4:8], "little")
            continue
        try:
            found = zstandard.get_frame_parameters(head)
            end = at + zstandard.frame_header_size(head)
        except zstandard.ZstdError as error:
            raise _damaged(at, error) from None
        last = 0
        while not last and (blocks := blocks + 1) < _MOST_BLOCKS:
            block = int.from_bytes(view[end : end + 3], "little")
            last, kind, size = block & 1, block >> 1 & 3, block >> 3
            end += 3 + (1 if kind == _REPEATED else size)
            if end > len(view):
                raise _unended(len(view))
        yield _Frame(
            found.window_size, 0 if found.content_size == zstandard.CONTENTSIZE_UNKNOWN else found.content_size
        )
        at = end + 4 * found.has_checksum


def _damaged(at: int, error: Exception) -> InvalidFile:
    return InvalidFile(Problem(f"zstd frame near byte {at:,}", f"is damaged ({error})", "zstd"))


def _unended(at: int) -> InvalidFile:
    return InvalidFile(Problem("zstd frame", f"does not end by byte {at:,}", "a whole frame"))
