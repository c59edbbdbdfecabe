"""Read and write the container of .svoq files: a header, a table of parts, the parts, a checksum. Little-endian.

0    'SVOQ' | u8 version = 1 | u8 coding | u8 basis | u8 parts
8    u16 width, height, depth | u16 0
16   u32 masks | u32 leaves
24   f64 origin x 3, voxel_size x 3
72   f64 colour_step, density_step, density_scale, mixing_scale
104  a line for each part: u8 kind, u8 end, u16 0, u32 bytes, u32 bytes when unpacked (0: not packed)
     the parts, one after the other
-4   u32 CRC-32 (zlib's) of all bytes before it
"""

from __future__ import annotations

import zlib
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from nerfbake.errors import InvalidFile, Problem

MAGIC, VERSION = b"SVOQ", 1
HEADER = np.dtype([
    ("magic", "S4"), ("version", "u1"), ("coding", "u1"), ("basis", "u1"), ("parts", "u1"),
    ("size", "<u2", 3), ("zero", "<u2"), ("masks", "<u4"), ("leaves", "<u4"),
    ("origin", "<f8", 3), ("voxel_size", "<f8", 3),
    ("colour_step", "<f8"), ("density_step", "<f8"), ("density_scale", "<f8"), ("mixing_scale", "<f8"),
])  # fmt: skip
PART = np.dtype([("kind", "u1"), ("end", "u1"), ("zero", "<u2"), ("size", "<u4"), ("unpacked", "<u4")])
CHECKSUM = 4  # bytes
BASIS, TOPOLOGY, COEFFICIENTS, PADDING = range(4)  # kinds of parts
NAMES = ("basis", "topology", "coefficients", "padding")


class SvoqPart(NamedTuple):
    """kind: see above. end: one past the last channel of coefficients, else 0. unpacked: the size, 0 if not packed."""

    kind: int
    end: int
    data: memoryview
    unpacked: int = 0


def write_file(header: np.void, parts: Sequence[SvoqPart]) -> Iterator[bytes | memoryview]:
    """Yield the file in pieces. The magic, version and number of parts in the header are filled in here."""
    table = np.zeros(len(parts), PART)
    for line, part in zip(table, parts, strict=True):
        line["kind"], line["end"], line["size"], line["unpacked"] = part.kind, part.end, len(part.data), part.unpacked
    header["magic"], header["version"], header["parts"] = MAGIC, VERSION, len(parts)
    pieces: list[bytes | memoryview] = [header.tobytes() + table.tobytes(), *(part.data for part in parts)]
    checksum = 0
    for piece in pieces:
        checksum = zlib.crc32(piece, checksum)
        yield piece
    yield checksum.to_bytes(CHECKSUM, "little")


def file_size(parts: Sequence[SvoqPart]) -> int:
    """The size in bytes of a file with these parts."""
    return HEADER.itemsize + len(parts) * PART.itemsize + sum(len(part.data) for part in parts) + CHECKSUM


def read_file(view: memoryview) -> tuple[np.void, list[SvoqPart]]:
    """Return the header and the parts. Raises InvalidFile if the file is cut off, damaged, or of another version."""
    if len(view) < HEADER.itemsize + CHECKSUM:
        found = f"has {len(view):,} bytes"
        raise InvalidFile(Problem("the file", found, f"a header of {HEADER.itemsize} bytes and its parts"))
    header = np.frombuffer(view, HEADER, 1)[0]
    if header["magic"] != MAGIC:
        raise InvalidFile(Problem("the file", f"starts with {bytes(view[:4]).hex(' ')}", "SVOQ"))
    if header["version"] != VERSION:
        raise InvalidFile(Problem("version", f"is {header['version']}", f"{VERSION}"))
    if header["zero"]:
        raise InvalidFile(Problem("the bytes before masks", f"are {header['zero']}", "0, as in version 1"))
    start = HEADER.itemsize + int(header["parts"]) * PART.itemsize
    if start + CHECKSUM > len(view):
        raise InvalidFile(Problem("the file", f"ends in its table of {header['parts']} parts", "a whole file"))
    table = np.frombuffer(view, PART, int(header["parts"]), HEADER.itemsize)
    sizes = [int(size) for size in table["size"]]
    if (size := start + sum(sizes) + CHECKSUM) != len(view):
        raise InvalidFile(Problem("the file", f"has {len(view):,} bytes", f"{size:,}, as its parts declare"))
    checksum = int.from_bytes(view[-CHECKSUM:], "little")
    if (own := zlib.crc32(view[:-CHECKSUM])) != checksum:
        found = f"is damaged: its checksum is {own:08x}"
        raise InvalidFile(Problem("the file", found, f"{checksum:08x}, as stored in it"))
    if table["zero"].any():
        raise InvalidFile(Problem("a line of the table of parts", "has bytes that are not 0", "0, as in version 1"))
    ends = np.cumsum(sizes) + start
    parts = [
        SvoqPart(int(line["kind"]), int(line["end"]), view[end - size : end], int(line["unpacked"]))
        for line, end, size in zip(table, ends.tolist(), sizes, strict=True)
    ]
    return header, parts
