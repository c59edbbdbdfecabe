"""Compress and decompress Zstandard files (.zst) of any format, with reproducible bytes and a memory limit."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import pairwise
from typing import NamedTuple

import zstandard

from nerfbake import memory
from nerfbake.errors import InvalidFile, Problem

LEVEL = 3
MAX_WINDOW = 1 << 27  # limit of the zstd command line
_CHUNK = 1 << 20
_PIECE = 1 << 20  # bytes that are decompressed before the next memory check
_BLOCK = 1 << 17  # bytes: the largest content of a block
_HEAD = 18  # bytes of the longest frame header
_REPEATED, _COMPRESSED = 1, 2  # kinds of blocks: one repeated byte; compressed
_MOST_BLOCKS = 1_000_000  # 128 GB of content; finding them takes a second
_SKIPPED = range(0x184D2A50, 0x184D2A60)  # magic numbers of skippable frames, which have no content


def compress(pieces: Iterable[bytes | memoryview]) -> Iterator[bytes]:
    """Compress to one frame with a checksum, on one thread: more threads would split it differently."""
    compressor = zstandard.ZstdCompressor(level=LEVEL, write_checksum=True).compressobj()
    for piece in pieces:
        for start in range(0, len(piece), _CHUNK):
            if packed := compressor.compress(piece[start : start + _CHUNK]):
                yield packed
    yield compressor.flush()


def decompress(view: memoryview) -> memoryview:
    """Decompress all frames. Raises InvalidFile; raises MemoryLimit before the content exceeds the memory limit."""
    frames = list(_frames(view))
    memory.require("the decompressed file", sum(frame.size for frame in frames))
    out = bytearray()
    context = zstandard.ZstdDecompressor(max_window_size=MAX_WINDOW)
    for frame in frames:
        window = min(frame.window, MAX_WINDOW)
        memory.require("zstd's window", window)
        content = context.decompressobj()
        for first, end in pairwise(frame.cuts):
            # A growing buffer over-allocates by an eighth.
            memory.require("the decompressed file", window + _PIECE + len(out) // 8)
            try:
                piece = content.decompress(view[first:end])
            except zstandard.ZstdError as error:
                raise _damaged(first, error) from None
            memory.hold("the decompressed file", len(piece))
            out += piece
        if not content.eof:
            raise _unended(len(view))
    return memoryview(out).toreadonly()


def decompress_exactly(view: memoryview, size: int, what: str) -> bytes:
    """Return the `size` bytes of one frame, which ends with the view; its checksum is verified if it has one.

    The content is counted until the surrounding memory.scope() ends. Raises InvalidFile if it has fewer or more bytes,
    or is damaged; MemoryLimit.
    """
    if size > _BLOCK * (len(view) // 4):  # a block of one repeated byte takes four
        found = f"declares {size:,} bytes from {len(view):,}"
        raise InvalidFile(Problem(what, found, f"{_BLOCK // 4:,} times as many, zstd's bound"))
    try:
        declared = zstandard.get_frame_parameters(view[:_HEAD])
    except zstandard.ZstdError as error:
        raise _unwhole(what, error) from None
    memory.hold(what, size)
    content = declared.content_size
    if content not in (size, zstandard.CONTENTSIZE_UNKNOWN):
        raise InvalidFile(Problem(what, f"holds {content:,} bytes", f"{size:,} exactly"))
    # A frame that declares its content is decompressed in place, without a window; another one fills no more of it.
    memory.require("zstd's window", min(declared.window_size, size) if content != size else 0)
    context = zstandard.ZstdDecompressor(max_window_size=MAX_WINDOW)
    try:
        data = context.decompress(view, max_output_size=size, allow_extra_data=False)
    except zstandard.ZstdError as error:
        with memory.lent(what, size + 1), context.stream_reader(view) as reader:
            try:
                if len(reader.read(size + 1)) > size:
                    raise InvalidFile(Problem(what, f"holds more than {size:,} bytes", f"{size:,} exactly"))
            except zstandard.ZstdError:
                pass  # damaged, and not too long
        raise _unwhole(what, error) from None
    if len(data) != size:
        raise InvalidFile(Problem(what, f"holds {len(data):,} bytes", f"{size:,} exactly"))
    return data


def _unwhole(what: str, error: Exception) -> InvalidFile:
    return InvalidFile(Problem(what, f"is damaged ({error})", "a whole zstd frame"))


class _Frame(NamedTuple):
    """The sizes that a frame declares in bytes, and where to split it so that no part decompresses beyond _PIECE."""

    window: int
    size: int  # of its content; 0 if it does not declare it
    cuts: list[int]  # offsets, from its first byte to its end


def _frames(view: memoryview) -> Iterator[_Frame]:
    """Find the frames by the sizes of their blocks alone: a zip bomb is rejected before any decompression."""
    at = blocks = 0
    while at < len(view):
        head = view[at : at + _HEAD]
        if int.from_bytes(head[:4], "little") in _SKIPPED:
            at += 8 + int.from_bytes(head[4:8], "little")
            if at > len(view):
                raise _unended(len(view))
            continue
        try:
            found = zstandard.get_frame_parameters(head)
            end = at + zstandard.frame_header_size(head)
        except zstandard.ZstdError as error:
            raise _damaged(at, error) from None
        cuts, last, room = [at], 0, _PIECE
        while not last:
            blocks += 1
            block = int.from_bytes(view[end : end + 3], "little")
            last, kind, size = block & 1, block >> 1 & 3, block >> 3
            if (room := room - (_BLOCK if kind == _COMPRESSED else size)) < 0:
                cuts.append(end)
                room = _PIECE - _BLOCK
            end += 3 + (1 if kind == _REPEATED else size)
            if end > len(view):
                raise _unended(len(view))
            if blocks > _MOST_BLOCKS:
                raise InvalidFile(Problem("zstd", f"has more than {_MOST_BLOCKS:,} blocks", f"{_MOST_BLOCKS:,}"))
        at = end + 4 * found.has_checksum
        content = found.content_size
        yield _Frame(
            found.window_size, 0 if content == zstandard.CONTENTSIZE_UNKNOWN else content, [*cuts, min(at, len(view))]
        )


def _damaged(at: int, error: Exception) -> InvalidFile:
    return InvalidFile(Problem(f"zstd frame near byte {at:,}", f"is damaged ({error})", "zstd"))


def _unended(at: int) -> InvalidFile:
    return InvalidFile(Problem("zstd frame", f"does not end by byte {at:,}", "a whole frame"))
