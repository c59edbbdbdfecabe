r"""Write a package (.usdz): a zip archive whose files are stored and start at multiples of 64 bytes.

    PK 03 04 | 26 bytes | name | extra: 86 19, u16 size, zeros | the file      for each file, the layer first
    PK 01 02 | 42 bytes | name                                                 for each file
    PK 05 06 | 18 bytes

All dates are 1980-01-01, so that the same files give the same bytes. A package is below 4 GiB.
Source: OpenUSD, "USDZ File Format Specification" 1.3; PKWARE's APPNOTE.TXT, 4.3.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence

import deflate

from nerfbake.errors import InvalidScene, Problem
from nerfbake.formats.wire.usd.crate import encode_crate
from nerfbake.formats.wire.usd.stage import UsdStage

ENDINGS = (".usda", ".usdc", ".usd", ".png", ".jpg", ".jpeg")  # of files that a package may have
_ALIGNED = 64
_DATE = 1 << 5 | 1  # 1980-01-01
_VERSION = 10
_UTF8 = 1 << 11  # of names
_EXTRA = 0x1986
_MOST = (1 << 32) - 1  # bytes
_LOCAL, _ENTRY, _LAST = "<4s5H3I2H", "<4s6H3I5H2I", "<4s4H2IH"


def package_stage(stage: UsdStage, beside: Sequence[tuple[str, Sequence[bytes]]] = ()) -> Iterator[bytes | memoryview]:
    """Yield the archive of a stage, as a crate. beside: the files that it refers to. Raises InvalidScene."""
    return encode_package([("scene.usdc", list(encode_crate(stage))), *beside])


def encode_package(files: Sequence[tuple[str, Sequence[bytes | memoryview]]]) -> Iterator[bytes | memoryview]:
    """Yield the archive in pieces. files: names with their bytes in pieces, the layer first.

    Raises InvalidScene if a file is of a type that packages do not have, or if the package would be too large.
    """
    at, entries = 0, []
    for name, pieces in files:
        if not name.endswith(ENDINGS):
            raise InvalidScene(Problem(f"the file {name}", "cannot be in a .usdz", ", ".join(ENDINGS)))
        path = name.encode()
        size, crc = 0, 0
        for piece in pieces:
            size, crc = size + len(piece), deflate.crc32(piece, crc)
        flag = 0 if path.isascii() else _UTF8
        start = at + struct.calcsize(_LOCAL) + len(path)
        extra = 4 + -(start + 4) % _ALIGNED
        if start + extra + size > _MOST:
            raise InvalidScene(Problem("the package", f"has {start + extra + size:,} bytes", f"{_MOST:,}, or .usdc"))
        facts = (flag, 0, 0, _DATE, crc, size, size, len(path))
        yield struct.pack(_LOCAL, b"PK\3\4", _VERSION, *facts, extra) + path
        yield struct.pack("<HH", _EXTRA, extra - 4).ljust(extra, b"\0")
        yield from pieces
        entries.append(struct.pack(_ENTRY, b"PK\1\2", _VERSION, _VERSION, *facts, 0, 0, 0, 0, 0, at) + path)
        at = start + extra + size
    directory = b"".join(entries)
    yield directory
    yield struct.pack(_LAST, b"PK\5\6", 0, 0, len(entries), len(entries), len(directory), at, 0)
