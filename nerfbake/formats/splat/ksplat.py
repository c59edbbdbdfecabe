"""Read Gaussian splats from .ksplat files (GaussianSplats3D), at all three levels of compression.

    0          4096               4096 + 1024 s
    | header   | s section heads  | sections: lengths of partial buckets, u32 | centres of buckets, 3 f32 | rows
    u8 0, u8 minor version, 2 x 0, u32 s, u32 used sections, u32 most splats, u32 splats, u16 level, 14 bytes,
    f32 SH of byte 0, f32 SH of byte 255 (0 and 0: -1.5 and 1.5)

A head: u32 splats, most splats, splats of a full bucket, buckets; f32 edge of a block; u16 bytes of a bucket's centre,
2 bytes; u32 range (0: 32,767), u32 bytes of all centres, full buckets, partial buckets; u16 SH degree.

    level  x y z                               scales   w x y z   r g b a   SH
    0      f32                                 3 f32    4 f32     4 u8      f32
    1      u16: (v - range) block / 2 / range  3 f16    4 f16     4 u8      f16
    2      the same, from the bucket's centre  3 f16    4 f16     4 u8      u8

Scales are linear, opacity is a / 255, the first SH coefficient (c / 255 - 1/2) / 0.28209479. The others are stored by
degree, then all red, green and blue ones. The full buckets come first. The numbers are those of a .ply.

Source: mkkellogg/GaussianSplats3D (SplatBuffer.js); playcanvas/splat-transform (read-ksplat.ts).
"""

from __future__ import annotations

import struct
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake import memory
from nerfbake.errors import InvalidFile, InvalidScene, Problem
from nerfbake.kernels.arrays import Floats
from nerfbake.scene.basis import SH0
from nerfbake.scene.splats import BASES, SplatRows, Splats, join_splats, splats_in_blocks, splats_size

_HEAD, _SECTION = 4096, 1024  # bytes
_FIELDS = struct.Struct("<BBxxIIIIH")
_SECTION_FIELDS = struct.Struct("<IIIIfHxxIIIIH")
_RANGE_AT = 36  # of the header: SH of the lowest and the highest byte
_USUAL = 1.5  # SH of the highest byte
_FULL = 32767  # range of a quantised coordinate
_MOST_SECTIONS = 10_000
_MOST_DEGREE = 3
# By level: types of centres, of scales and quaternions, and of SH.
_LEVELS = (("<f4", "<f4", "<f4"), ("<u2", "<f2", "<f2"), ("<u2", "<f2", "u1"))


class _Section(NamedTuple):
    n: int
    most: int
    per_bucket: int
    buckets: int
    block: float
    bucket_bytes: int
    range: int
    full: int
    partial: int
    degree: int
    at: int  # the first byte of its data

    def row(self, level: int) -> np.dtype[np.void]:
        centre, half, rest = _LEVELS[level]
        sh = (rest, (3 * (BASES[self.degree] - 1),))
        return np.dtype([("mean", centre, 3), ("scale", half, 3), ("quat", half, 4), ("colour", "u1", 4), ("sh", *sh)])

    @property
    def rows_at(self) -> int:
        return self.at + 4 * self.partial + self.bucket_bytes * self.buckets

    def end(self, level: int) -> int:
        return self.rows_at + self.row(level).itemsize * self.most


def recognise(view: memoryview) -> bool:
    """Return True if the heads describe sections that end where the file does."""
    try:
        level, sections = _sections(view)
    except (InvalidFile, InvalidScene):
        return False
    return bool(sections) and sections[-1].end(level) == len(view)


def decode(view: memoryview) -> Splats:
    """Parse splats. Raises InvalidFile, InvalidScene, MemoryLimit."""
    level, sections = _sections(view)
    low, high = struct.unpack_from("<ff", view, _RANGE_AT)
    low, high = (low, high) if low or high else (-_USUAL, _USUAL)
    used = [section for section in sections if section.n]
    if not used:
        raise InvalidScene(Problem("the splats", "have no rows", "at least one splat"))
    parts = [_splats(view, section, level, (low, high)) for section in used]
    if len(parts) == 1:
        return parts[0]
    memory.hold("the splats", splats_size(sum(part.n for part in parts), max(part.B for part in parts)))
    return join_splats(parts)


def _sections(view: memoryview) -> tuple[int, list[_Section]]:
    """Return the level, and the sections, whose data are in the file. Raises InvalidFile."""
    if len(view) < _HEAD:
        raise InvalidFile(Problem("the .ksplat", f"has {len(view):,} bytes", f"a header of {_HEAD:,}"))
    major, minor, count, _, _, told, level = _FIELDS.unpack_from(view)
    if major != 0 or minor < 1:
        raise InvalidFile(Problem("version", f"is {major}.{minor}", "0.1 or later"))
    if level >= len(_LEVELS):
        raise InvalidFile(Problem("the level of compression", f"is {level}", "0, 1 or 2"))
    at = _HEAD + _SECTION * count
    if count > _MOST_SECTIONS or at > len(view):
        found = f"are {count:,} in {len(view):,} bytes"
        raise InvalidFile(Problem("the sections", found, f"up to {_MOST_SECTIONS:,}, each with {_SECTION:,} bytes"))
    sections: list[_Section] = []
    for k in range(count):
        n, most, per, buckets, block, size, reach, _, full, partial, degree = _SECTION_FIELDS.unpack_from(
            view, _HEAD + _SECTION * k
        )
        place = f"section {k}"
        if degree > _MOST_DEGREE:
            raise InvalidFile(Problem(f"{place}'s SH degree", f"is {degree}", f"0 to {_MOST_DEGREE}"))
        section = _Section(n, most, per, buckets, block, size, reach or _FULL, full, partial, degree, at)
        at = section.end(level)
        if n > most or at > len(view):
            found = f"has {n:,} of {most:,} splats, up to byte {at:,}"
            raise InvalidFile(Problem(place, found, f"as many as fit into the {len(view):,} bytes of the file"))
        if level and n:
            _require_buckets(section, place)
        sections.append(section)
    if (total := sum(section.n for section in sections)) != told:
        raise InvalidFile(Problem("the sections", f"have {total:,} splats", f"{told:,}, as the header says"))
    return level, sections


def _require_buckets(section: _Section, place: str) -> None:
    if section.bucket_bytes < 12 or section.full + section.partial > section.buckets:
        found = f"has {section.full + section.partial:,} of {section.buckets:,} buckets of {section.bucket_bytes} bytes"
        raise InvalidFile(Problem(place, found, "buckets of 12 bytes or more"))


def _splats(view: memoryview, section: _Section, level: int, ends: tuple[float, float]) -> Splats:
    B, n = BASES[section.degree], section.n
    table = np.frombuffer(view, section.row(level), n, section.rows_at)
    buckets: Floats | None = None
    ends_of: npt.NDArray[np.int64] | None = None
    if level:
        lengths = np.frombuffer(view, "<u4", section.partial, section.at).astype(np.int64)
        memory.hold("the buckets", 40 * section.buckets)
        counts = np.concatenate([np.full(section.full, section.per_bucket, np.int64), lengths])
        ends_of = np.cumsum(counts)
        if not len(ends_of) or ends_of[-1] < n:
            found = f"have room for {int(ends_of[-1]) if len(ends_of) else 0:,} splats"
            raise InvalidFile(Problem("the buckets", found, f"{n:,}"))
        rows_of = np.ndarray(
            (section.buckets, 3), "<f4", view, section.at + 4 * section.partial, (section.bucket_bytes, 4)
        )
        with np.errstate(invalid="ignore"):
            buckets = rows_of.astype(np.float64)

    def rows(block: slice) -> SplatRows:
        part = table[block]
        with np.errstate(invalid="ignore", over="ignore"):
            means = part["mean"].astype(np.float64)
            if buckets is not None and ends_of is not None:
                which = np.searchsorted(ends_of, np.arange(block.start, block.start + len(part)), side="right")
                means = (means - section.range) * (section.block / 2 / section.range) + buckets[which]
            sh = np.empty((len(part), B, 3))
            sh[:, 0] = (part["colour"][:, :3] / 255 - 0.5) / SH0
            rest = part["sh"].astype(np.float64)
            if level == 2:
                rest = rest / 255 * (ends[1] - ends[0]) + ends[0]
            for degree in range(1, section.degree + 1):
                first, last = BASES[degree - 1], BASES[degree]
                own = rest[:, 3 * (first - 1) : 3 * (last - 1)].reshape(len(part), 3, last - first)
                sh[:, first:last] = own.transpose(0, 2, 1)
            scales, quats = part["scale"].astype(np.float64), part["quat"].astype(np.float64)
        return SplatRows(means, scales, quats, part["colour"][:, 3] / 255, sh)

    return splats_in_blocks(n, B, rows)
