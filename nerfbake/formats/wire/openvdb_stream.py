"""What an OpenVDB file is made of: numbers and texts one after the other, whose places nothing but reading tells."""

from __future__ import annotations

import struct
from typing import Any

import numpy as np
import numpy.typing as npt

from nerfbake.errors import InvalidFile, Problem

MAGIC, VERSION = 0x56444220, 224
UUID = b"00000000-0000-0000-0000-000000000000"
ZIP, ACTIVE_MASK, BLOSC = 1, 2, 4  # of a grid's compression flags
PACKED = ZIP | BLOSC  # blosc goes first where a grid has both
ACTIVE_ONLY, ALL_VALUES = 0, 6  # codes before a node's values
MAX_TEXT = 1 << 20
MAX_ENTRIES = 10_000


def text(value: str | bytes) -> bytes:
    raw = value if isinstance(value, bytes) else value.encode()
    return struct.pack("<I", len(raw)) + raw


class Stream:
    """A file read from front to back."""

    def __init__(self, view: memoryview, at: int = 0) -> None:
        self.view, self.at = view, at

    def take(self, size: int, what: str) -> memoryview:
        """The next bytes. Raises InvalidFile if there are not so many."""
        end = self.at + size
        if size < 0 or end > len(self.view):
            found = f"would stand at bytes {self.at:,} to {end:,}"
            raise InvalidFile(Problem(what, found, f"up to {len(self.view):,}, the file's end"))
        piece = self.view[self.at : end]
        self.at = end
        return piece

    def numbers(self, layout: str, what: str) -> tuple[Any, ...]:
        return struct.unpack("<" + layout, self.take(struct.calcsize("<" + layout), what))

    def array(self, dtype: str, count: int, what: str) -> npt.NDArray[Any]:
        kind = np.dtype(dtype)
        return np.frombuffer(self.take(count * kind.itemsize, what), kind)

    def raw_text(self, what: str) -> bytes:
        (size,) = self.numbers("I", what)
        if size > MAX_TEXT:
            raise InvalidFile(Problem(what, f"has {size:,} bytes", f"{MAX_TEXT:,} at most"))
        return bytes(self.take(size, what))

    def text(self, what: str) -> str:
        return self.raw_text(what).decode("utf-8", "replace")

    def metadata(self) -> dict[str, bytes]:
        """Values by name, whatever their types."""
        (count,) = self.numbers("I", "metadata")
        if count > MAX_ENTRIES:
            raise InvalidFile(Problem("metadata", f"has {count:,} entries", f"{MAX_ENTRIES:,} at most"))
        entries = {}
        for _ in range(count):
            name, _ = self.text("metadata"), self.text("metadata")
            entries[name] = self.raw_text(f"metadata {name[:40]!r}")
        return entries
