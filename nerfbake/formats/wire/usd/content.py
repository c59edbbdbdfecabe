"""Tell what a file of USD holds without OpenUSD: its container, and the names of types in it.

The names in a crate are its tokens, in a block of LZ4, which is decoded here up to a limit. It is enough to choose
between the formats with one extension; it does not say that a file is valid.
Source: pxr/usd/sdf/crateFile.cpp of OpenUSD 26.11; lz4_Block_format.md of lz4.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterable
from contextlib import suppress

from nerfbake.errors import InvalidFile, NerfbakeError, Problem
from nerfbake.formats.wire.usd import crate, text
from nerfbake.formats.wire.zip_reader import MAX_MEMBERS, ZIP_MAGIC, ZipReader, npz_keys

LAYERS = (".usda", ".usdc", ".usd")
VARIANTS = "representation"  # the set of variants that nerfbake writes: the same scene as splats, mesh, volume
_MOST_TOKENS = 1 << 20  # bytes that are looked at
_LONGEST = 200  # characters of a name


def kind_of_layer(view: memoryview) -> str:
    """Return .usda or .usdc, by the content. Raises InvalidFile."""
    if bytes(view[: len(crate.MAGIC)]) == crate.MAGIC:
        return ".usdc"
    if bytes(view[: len(text.MAGIC)]) == text.MAGIC:
        return ".usda"
    raise InvalidFile(Problem("the file", "does not start as a layer of USD", "#usda, PXR-USDC, or a .usdz"))


def has_type(view: memoryview, *names: str) -> bool:
    """Return whether a file of USD names one of these types of prims; False for any other file."""
    if bytes(view[:4]) in ZIP_MAGIC:
        if not any(key.endswith(LAYERS) for key in npz_keys(view)):
            return False
        with suppress(NerfbakeError):
            archive = ZipReader(view, "a .usdz")
            for name in archive.members:
                if name.endswith(LAYERS) and has_type(archive.unpacked(name, name), *names):
                    return True
        return False
    if bytes(view[: len(text.MAGIC)]) == text.MAGIC:
        return re.search(rb"\b(?:def|over|class)\s+(?:%b)\b" % "|".join(names).encode(), view) is not None
    return not {name.encode() for name in names}.isdisjoint(_tokens(view).split(b"\0"))


def selected_variant(view: memoryview, variant_set: str) -> str | None:
    """Return the selection of a set of variants in a layer of text, or in that of a package; None if there is none."""
    if bytes(view[:4]) in ZIP_MAGIC:
        with suppress(NerfbakeError):
            archive = ZipReader(view, "a .usdz")
            for name in archive.members:
                if name.endswith(LAYERS) and (found := selected_variant(archive.unpacked(name, name), variant_set)):
                    return found
        return None
    found_here = re.search(rb'\bstring %b = "(\w+)"' % variant_set.encode(), view[:_MOST_TOKENS])
    is_text = bytes(view[: len(text.MAGIC)]) == text.MAGIC
    return found_here[1].decode() if is_text and found_here else None


def is_usd(view: memoryview) -> bool:
    """Return whether this is a layer or a package of USD."""
    if bytes(view[:4]) in ZIP_MAGIC:
        return any(key.endswith(LAYERS) for key in npz_keys(view))
    return bytes(view[:8]).startswith((text.MAGIC, crate.MAGIC))


def package_names(members: Iterable[str]) -> list[str]:
    """Return the names of the files in a package, the first of which is its layer. Raises InvalidFile."""
    names = [name for name in members if not name.endswith("/")]
    for name in names:
        parts = name.split("/")
        odd = len(name) > _LONGEST or not name.isprintable() or re.search(r"[\\:]", name)
        if odd or name.startswith("/") or not all(parts) or {".", ".."} & {*parts}:
            raise InvalidFile(Problem("the package", f"has a file named {name[:80]!r}", "names below its own folder"))
    if not names or not names[0].endswith(LAYERS):
        found = f"starts with {names[0][:80]}" if names else "is empty"
        raise InvalidFile(Problem("the package", found, f"a layer as the first file: {', '.join(LAYERS)}"))
    nested = [name for name in names if name.endswith(".usdz")]
    if nested:
        raise InvalidFile(Problem("the package", f"has the package {nested[0][:80]}", "layers and textures"))
    assert len(names) <= MAX_MEMBERS
    return names


def _tokens(view: memoryview) -> bytes:
    """Return the tokens of a crate, with \0 between them; empty if they cannot be read."""
    if bytes(view[: len(crate.MAGIC)]) != crate.MAGIC:
        return b""
    with suppress(struct.error, IndexError):
        (toc,) = struct.unpack_from("<Q", view, 16)
        (count,) = struct.unpack_from("<Q", view, toc)
        for at in range(toc + 8, toc + 8 + 32 * min(count, 16), 32):
            name, start, _ = struct.unpack_from("<16sqq", view, at)
            if name.rstrip(b"\0") == b"TOKENS" and start >= 0:
                _, size, packed = struct.unpack_from("<QQQ", view, start)
                data = view[start + 24 : start + 24 + packed]
                if data[0] == 0:  # one chunk
                    return _unpacked(bytes(data[1:]), min(size, _MOST_TOKENS))
    return b""


def _unpacked(data: bytes, most: int) -> bytes:
    """Decode a block of LZ4 up to `most` bytes. Raises IndexError if it is damaged."""
    out, at = bytearray(), 0
    while at < len(data) and len(out) < most:
        token = data[at]
        at += 1
        size, at = _size(data, at, token >> 4)
        out += data[at : at + size]
        at += size
        if at >= len(data):
            break
        back = data[at] | data[at + 1] << 8
        size, at = _size(data, at + 2, token & 15)
        if not 0 < back <= len(out):
            raise IndexError("offset")
        piece = out[-back:]
        size += 4
        out += (piece * (size // len(piece) + 1))[:size] if size <= most else b""
    return bytes(out)


def _size(data: bytes, at: int, size: int) -> tuple[int, int]:
    """Return the length that a nibble starts, and the index after it."""
    if size == 15:
        while True:
            more = data[at]
            size, at = size + more, at + 1
            if more != 255:
                break
    return size, at
