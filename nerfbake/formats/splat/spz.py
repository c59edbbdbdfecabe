r"""Read Gaussian splats from .spz files (versions 1 to 4), and write versions 3 and 4.

    0     4        8   12     13    14    15       16          20       32
    "NGSP"|version |n  |degree|bits |flags|streams |toc offset |12 x 0  | extensions | toc | streams   version 4
    "NGSP"|version |n  |degree|bits |flags|0       | attributes                             1 to 3, in gzip or not

toc: two u64 for each stream, its packed and unpacked size. A stream is zstd; the empty ones are left out.

    positions  3 x 24 bits, signed, / 2^bits (version 1: 3 x float16)
    alphas     u8 / 255
    colours    (u8 / 255 - 1/2) / 0.15, the first SH coefficients
    scales     e^(u8 / 16 - 10)
    rotations  31 [which of x y z w 2 | sign 1, size 9 | sign 1, size 9 | sign 1, size 9] 0, size / 511 / sqrt 2
               (versions 1 and 2: x y z as u8 / 127.5 - 1, w at least 0)
    sh         (u8 - 128) / 128, coefficient by coefficient, red green blue inside

Extensions: u32 type, u32 size, payload, one behind the other; in versions 1 to 3 behind the attributes. Only
0xADBE0003, which names the axes of the file (u32, 1 to 16, see scene/splat_axes.py; 0: not named), changes how it is
read. It is always written in version 4. In version 3 it is written only for other axes than right, up, back, because
readers of that version refuse it (three.js 0.187) or take its flag for antialiasing (Babylon.js 9.28).

Flags: 1 antialiased, 2 extensions, 0x80 levels of detail. Spark's build-lod writes these in versions 2 and 3: parents
are further rows, all opacities are halved, and behind the attributes are u16 the number of children of each row, then
u32 its first child.

Without names, x points right, y up and z back. Then y and z change their signs here, and so do quaternions and SH.

Source: nianticlabs/spz (load-spz.cc, coordinate-system-adobe.cc); sparkjsdev/spark (spark-lib, spz.rs).
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import replace
from typing import Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake import memory
from nerfbake.errors import InvalidFile, InvalidScene, Problem
from nerfbake.formats.splat.ply import with_largest
from nerfbake.formats.wire.deflate import MAX_INFLATION, gunzip, gunzip_start, gzip_whole
from nerfbake.formats.wire.zstd import compress, decompress_exactly
from nerfbake.kernels.arrays import Floats
from nerfbake.kernels.maths.elementary import exp, log
from nerfbake.scene.splat_axes import AXES, from_axes, to_axes
from nerfbake.scene.splats import BASES, Axes, SplatRows, Splats, splats_in_blocks

_MAGIC = b"NGSP"
_GZIP = b"\x1f\x8b"
_HEAD = struct.Struct("<4sIIBBBB")
_WHOLE_HEAD = 32  # bytes in version 4
_PARTS = ("positions", "alphas", "colours", "scales", "rotations", "sh")
_ANTIALIASED, _EXTENDED, _LEVELS = 1, 2, 0x80  # flags
_EXTENSIONS = 1 << 20  # bytes of them at most
_MOST_EXTENSIONS = 100
_A_NODE = 6  # bytes of a row in the tree of levels of detail
_MANY = 1 << 16  # splats that a file of any size may have
_MOST_PER_BYTE = 16  # splats
_COORDINATE_SYSTEM = 0xADBE0003
_USUAL: Axes = "RUB"
UNNAMED = "axes not named; read as right, up, back (SPZ's README)"
_OLD_READERS = (
    "version 4 of .spz; Spark 2.2, Omniverse's converter, gsply and Babylon.js without an extra, and older plug-ins of"
    " Unity and game engines read only up to 3, which `spz_version=3` writes"
)
_NAMES_IN_3 = (
    "names its axes in version 3 of .spz; three.js 0.187 refuses that, and Babylon.js 9.28 takes it for antialiased"
)
_MOST_BITS = 23  # fractional bits
_LARGEST = (1 << 23) - 1
_LEAST = 1e-30  # scale whose logarithm is taken for 0
_STEPS = (0, 8, 16, 16, 16)  # by degree, between the codes of SH in a small file: 5 bits, then 4
_MOST_OF_3 = 3  # degree that readers of version 3 know
MOST_DEGREE = 4
KEEPS_ORIGIN = False
KEEPS_UP = False
_ALLOWED = "a whole .spz"


def recognise(view: memoryview) -> bool:
    """Return True for the magic number, in the clear, or in gzip before a version below 4."""
    if bytes(view[:2]) == _GZIP:
        try:
            start = gunzip_start(view, 8, "gzip")
        except InvalidFile:
            return False
        return start[:4] == _MAGIC and int.from_bytes(start[4:], "little") < 4
    return bytes(view[:4]) == _MAGIC


class _Head(NamedTuple):
    """The first bytes of a file."""

    version: int
    n: int
    degree: int
    bits: int
    flags: int
    last: int  # the number of streams in version 4, reserved in the others

    @property
    def sizes(self) -> list[int]:
        """The bytes of each attribute."""
        place, turn = 6 if self.version == 1 else 9, 4 if self.version >= 3 else 3
        return [self.n * each for each in (place, 1, 3, 3, turn, 3 * (BASES[self.degree] - 1))]


def _head(view: memoryview) -> _Head:
    """Parse the header. Raises InvalidFile, InvalidScene for no splats."""
    packed = bytes(view[:2]) == _GZIP
    head = gunzip_start(view, _HEAD.size, "the .spz") if packed else bytes(view[: _HEAD.size])
    if len(head) < _HEAD.size or head[:4] != _MAGIC:
        raise InvalidFile(Problem("the .spz", "has no whole header", _ALLOWED))
    found = _Head(*_HEAD.unpack(head)[1:])
    if found.version not in ((1, 2, 3) if packed else (1, 2, 3, 4)):
        raise InvalidFile(Problem("version", f"is {found.version}", "1 to 3, mostly in gzip, or 4 without"))
    if found.degree >= len(BASES):
        raise InvalidFile(Problem("the SH degree", f"is {found.degree}", "0 to 4"))
    if found.bits > 24:
        raise InvalidFile(Problem("the fractional bits", f"are {found.bits}", "0 to 24"))
    known = _ANTIALIASED | _EXTENDED | (_LEVELS if found.version < 4 else 0)
    if unknown := found.flags & ~known:
        allowed = f"1 antialiased, 2 extensions{', 0x80 levels of detail' if found.version < 4 else ''}"
        raise InvalidFile(Problem("the flags", f"have 0x{unknown:02x}", allowed))
    if not found.n:
        raise InvalidScene(Problem("the splats", "have no rows", "at least one splat"))
    # A real file has 8 bytes or more for each splat, because the low bytes of coordinates are noise. Without a limit,
    # 150 kB that say nothing would take ten seconds and a gigabyte.
    if found.n > max(_MANY, _MOST_PER_BYTE * len(view)):
        text = f"has {len(view):,} bytes for {found.n:,} splats"
        raise InvalidFile(Problem("the .spz", text, f"{_MOST_PER_BYTE} splats a byte at most"))
    return found


def decode(view: memoryview) -> Splats:
    """Parse splats. Raises InvalidFile, InvalidScene, MemoryLimit.

    If an extension names the axes of the file, they are obeyed. Other extensions are ignored with a note. Of a file
    with levels of detail, the finest is read.
    """
    head = _head(view)
    if head.version < 4:
        parts, extensions, notes = _attributes(view, head)
    else:
        parts, extensions, notes = _streams(view, head)
    n = len(parts[1])
    B = BASES[head.degree]
    system, more = _axes(extensions)
    positions, alphas, colours, scales, rotations, coefficients = (np.frombuffer(part, np.uint8) for part in parts)
    places = positions.reshape(n, -1)
    turns = rotations.reshape(n, -1)
    rest = coefficients.reshape(n, B - 1, 3)

    def rows(block: slice) -> SplatRows:
        dc = (colours.reshape(n, 1, 3)[block] / 255 - 0.5) / 0.15
        quats = _rotations(turns[block].view("<u4")[:, 0]) if head.version >= 3 else _first_rotations(turns[block])
        return SplatRows(
            _halves(places[block]) if head.version == 1 else _positions(places[block]) / 2.0**head.bits,
            exp(scales.reshape(n, 3)[block] / 16 - 10),
            quats[:, [3, 0, 1, 2]],
            alphas[block] / 255,
            np.concatenate([dc, (rest[block] - 128.0) / 128], axis=1),
        )

    antialiased = bool(head.flags & _ANTIALIASED)
    splats = splats_in_blocks(n, B, rows, antialiased=antialiased, notes=(*notes, *more))
    return replace(from_axes(splats, system), axes_known=UNNAMED not in more)


def _attributes(view: memoryview, head: _Head) -> tuple[list[memoryview], memoryview, list[str]]:
    """Return the attributes of versions 1 to 3, the bytes of extensions, and notes. Raises InvalidFile, MemoryLimit."""
    need = sum(head.sizes) + (_A_NODE * head.n if head.flags & _LEVELS else 0)
    if bytes(view[:2]) == _GZIP:
        if _HEAD.size + need > MAX_INFLATION * len(view) + 64:
            found = f"declares {_HEAD.size + need:,} bytes from {len(view):,}"
            raise InvalidFile(Problem("the .spz", found, f"{MAX_INFLATION} times as many, deflate's bound"))
        memory.require("the .spz", _HEAD.size + need)
        room = _EXTENSIONS if head.flags & _EXTENDED else 0
        view = gunzip(view, "the .spz", most=_HEAD.size + need + room)
    whole = view[_HEAD.size :]
    if len(whole) < need or (len(whole) > need and not head.flags & _EXTENDED):
        found = f"holds {len(whole):,} bytes of attributes"
        raise InvalidFile(Problem("the .spz", found, f"{need:,} for {head.n:,} splats"))
    notes = [f"byte {_HEAD.size - 1}, which is reserved, is {head.last} and not 0"] if head.last else []
    ends = np.cumsum(head.sizes)
    parts = [whole[int(end) - size : int(end)] for size, end in zip(head.sizes, ends, strict=True)]
    extensions = whole[need:] if head.flags & _EXTENDED else whole[:0]
    if head.flags & _LEVELS:
        parts, note = _leaves(parts, whole[sum(head.sizes) : need], head.n)
        notes.append(note)
    return parts, extensions, notes


def _leaves(parts: list[memoryview], tree: memoryview, n: int) -> tuple[list[memoryview], str]:
    """Return the rows of the attributes that have no children, with their own opacity, and a note.

    tree: u16 number of children of each row, then u32 first child of each row. Opacities of all rows are halved,
    because those of parents may exceed 1. Raises InvalidFile.
    """
    counts, starts = np.frombuffer(tree, "<u2", n), np.frombuffer(tree, "<u4", n, 2 * n)
    memory.hold("the levels of detail", sum(map(len, parts)) + 20 * n)
    if (ends := starts.astype(np.int64) + counts)[counts > 0].max(initial=0) > n:
        found = f"has children up to row {int(ends[counts > 0].max()):,} of {n:,}"
        raise InvalidFile(Problem("the tree of the levels of detail", found, "all of its rows in one .spz"))
    leaves = np.flatnonzero(counts == 0)
    if not len(leaves):
        raise InvalidFile(Problem("the tree of the levels of detail", "has no leaves", "rows without children"))
    chosen = [np.frombuffer(part, np.uint8).reshape(n, -1)[leaves] for part in parts]
    chosen[1] = np.minimum(chosen[1].astype(np.uint16) * 2, 255).astype(np.uint8)
    note = f"of the levels of detail (flag 0x80), only the finest is read: {len(leaves):,} of {n:,} rows"
    return [memoryview(np.ascontiguousarray(each).reshape(-1).data) for each in chosen], note


def _axes(extensions: memoryview) -> tuple[Axes, tuple[str, ...]]:
    """Return the axes of the file, and a note for each extension. Raises InvalidFile."""
    system: Axes | None = None
    at = 0
    notes: list[str] = []
    while at + 8 <= len(extensions):
        kind, size = struct.unpack_from("<II", extensions, at)
        payload = extensions[at + 8 : at + 8 + size]
        at += 8 + size
        if at > len(extensions) or len(notes) >= _MOST_EXTENSIONS:
            found = f"of type 0x{kind:08X} has {size:,} bytes, with {len(payload):,} left"
            raise InvalidFile(Problem("an extension", found, f"whole extensions, {_MOST_EXTENSIONS} at most"))
        if kind != _COORDINATE_SYSTEM:
            notes.append(f"extension 0x{kind:08X} is left out")
            continue
        number = int.from_bytes(payload[:4], "little")
        if size != 4 or number > len(AXES):
            found = f"has {size:,} bytes, with {number}"
            raise InvalidFile(Problem("the extension of the axes", found, f"4 bytes, with 0 to {len(AXES)}"))
        system = AXES[number - 1] if number else None
        if system not in (None, _USUAL):
            notes.append(f"an extension says that the axes of the file are {system} instead of {_USUAL}")
    if system is None:
        notes.append(UNNAMED)
    return system or _USUAL, tuple(dict.fromkeys(notes))


def _streams(view: memoryview, head: _Head) -> tuple[list[memoryview], memoryview, list[str]]:
    """Return the streams of version 4, with empty ones for those that are left out, the extensions, and notes.

    Raises InvalidFile, MemoryLimit.
    """
    count = head.last
    filled = [size for size in head.sizes if size]
    if count != len(filled):
        raise InvalidFile(Problem("the .spz", f"has {count} streams", f"{len(filled)}"))
    toc = int.from_bytes(view[16:20], "little")
    at = toc + 16 * count
    if toc < _WHOLE_HEAD or at > len(view):
        raise InvalidFile(Problem("the table of streams", f"is at byte {toc:,} of {len(view):,}", _ALLOWED))
    lengths = [int(length) for length in np.frombuffer(view, "<u8", 2 * count, toc)]
    found = []
    for name, size in zip(_PARTS, head.sizes, strict=True):
        if not size:
            found.append(memoryview(b""))
            continue
        packed, unpacked = lengths[:2]
        del lengths[:2]
        if unpacked != size:
            raise InvalidFile(Problem(f"stream {name}", f"declares {unpacked:,} bytes", f"{size:,}"))
        if packed > len(view) - at:
            raise InvalidFile(Problem(f"stream {name}", f"declares {packed:,} packed bytes", f"{len(view) - at:,}"))
        found.append(memoryview(decompress_exactly(view[at : at + packed], size, f"stream {name}")))
        at += packed
    if at != len(view):
        raise InvalidFile(Problem("the .spz", f"goes on after its streams, which end at byte {at:,}", _ALLOWED))
    notes = ["bytes 20 to 31, which are reserved, are not 0"] if any(view[20:_WHOLE_HEAD]) else []
    extended = head.flags & _EXTENDED
    if toc > _WHOLE_HEAD and not extended:
        notes.append(f"{toc - _WHOLE_HEAD:,} bytes before the table of streams are not read")
    return found, view[_WHOLE_HEAD:toc] if extended else view[:0], notes


def _positions(data: npt.NDArray[np.uint8]) -> Floats:
    """Return whole numbers (n, 3) of 24 bits: the top byte of a 32-bit one repeats the sign."""
    parts = data.reshape(-1, 3).astype(np.int32)
    whole = parts[:, 0] | parts[:, 1] << 8 | parts[:, 2] << 16
    return (whole - ((whole & 1 << 23) << 1)).reshape(-1, 3).astype(np.float64)


def _halves(data: npt.NDArray[np.uint8]) -> Floats:
    with np.errstate(invalid="ignore"):
        # The product makes signalling NaNs quiet, so that later arithmetic prints no warning.
        return data.view("<f2").reshape(-1, 3).astype(np.float64) * 1.0


def _rotations(words: npt.NDArray[np.uint32]) -> Floats:
    """Return the quaternions (n, 4), x y z w."""
    fields = np.stack([words >> shift & 1023 for shift in (20, 10, 0)], axis=1).astype(np.int64)
    three = np.where(fields & 512, -1.0, 1.0) * (fields & 511) / 511 * np.sqrt(0.5)
    largest = np.sqrt(np.maximum(0, 1 - (three * three).sum(axis=1)))
    return with_largest(three, largest, (words >> 30).astype(np.int64))


def _first_rotations(data: npt.NDArray[np.uint8]) -> Floats:
    three = data / 127.5 - 1
    return np.concatenate([three, np.sqrt(np.maximum(0, 1 - (three * three).sum(axis=1, keepdims=True)))], axis=1)


def encode(
    scene: Splats, *, small: bool = False, axes: Axes = _USUAL, spz_version: Literal[3, 4] = 4
) -> Iterator[bytes]:
    """Encode splats, with as many fractional bits as the farthest mean allows.

    small        store SH as Niantic's own writer does, in 5 bits for degree 1 and 4 bits above, which are packed into
                 fewer bytes; otherwise in 8 bits
    axes         of the file, which an extension names; version 3 does not name RUB
    spz_version  3: gzip, for readers that do not know 4

    Raises InvalidScene for means beyond 2^23, and for SH of degree 4 in version 3.
    """
    if spz_version == 3 and scene.degree > _MOST_OF_3:
        raise InvalidScene(Problem("sh", f"has degree {scene.degree}", f"0 to {_MOST_OF_3} in version 3 of a .spz"))
    scene.require_usable()
    scene = to_axes(scene, axes)
    n, B = scene.n, scene.B
    far = float(np.abs(scene.means).max())
    if far > _LARGEST:
        raise InvalidScene(Problem("means", f"reach {far:g}", f"{_LARGEST:,} in a .spz"))
    bits = next(bits for bits in range(_MOST_BITS, -1, -1) if far * 2.0**bits <= _LARGEST)
    memory.require("the .spz", n * 8 * (11 + 3 * B))
    whole = np.rint(scene.means.astype(np.float64) * 2.0**bits).astype("<i4")
    rest = np.rint(scene.sh[:, 1:].astype(np.float64) * 128 + 128)
    if small:
        steps = np.repeat(_STEPS, 2 * np.arange(len(_STEPS)) + 1)[1:B, None]
        rest = (rest + steps // 2) // steps * steps
    arrays = (
        whole.view(np.uint8).reshape(n, 3, 4)[..., :3],
        _bytes(scene.opacity.astype(np.float64) * 255),
        _bytes((scene.sh[:, 0].astype(np.float64) * 0.15 + 0.5) * 255),
        _bytes((log(np.maximum(scene.scales.astype(np.float64), _LEAST)) + 10) * 16),
        _words(scene.quats[:, [1, 2, 3, 0]].astype(np.float64)),
        _bytes(rest),
    )
    parts = [array.tobytes() for array in arrays if array.size]
    named = spz_version == 4 or axes != _USUAL
    flags = (_EXTENDED if named else 0) | (_ANTIALIASED if scene.antialiased else 0)
    extension = struct.pack("<III", _COORDINATE_SYSTEM, 4, AXES.index(axes) + 1) if named else b""
    head = _HEAD.pack(_MAGIC, spz_version, n, scene.degree, bits, flags, len(parts) if spz_version == 4 else 0)
    if spz_version == 3:
        yield gzip_whole([head, *parts, extension])
        return
    packed = [b"".join(compress([part])) for part in parts]
    yield head + struct.pack("<I12x", _WHOLE_HEAD + len(extension)) + extension
    for part, stream in zip(parts, packed, strict=True):
        yield struct.pack("<QQ", len(stream), len(part))
    yield from packed


def readers_note(*, spz_version: int = 4, axes: Axes = _USUAL, **options: object) -> str:
    """Return which programs do not read a file, or read it wrongly; '' if none is known."""
    if spz_version == 4:
        return _OLD_READERS
    return "" if axes == _USUAL else _NAMES_IN_3


def _bytes(values: npt.NDArray[np.floating]) -> npt.NDArray[np.uint8]:
    codes: npt.NDArray[np.uint8] = np.clip(np.rint(values), 0, 255).astype(np.uint8)
    return codes


def _words(quats: Floats) -> npt.NDArray[np.uint32]:
    """Return the words (n,) of quaternions (n, 4), x y z w."""
    rows, which = np.arange(len(quats)), np.abs(quats).argmax(axis=1)
    quats = np.where(quats[rows, which] < 0, -1.0, 1.0)[:, None] * quats
    words: npt.NDArray[np.uint32] = which.astype(np.uint32)
    for k in range(3):
        value = quats[rows, k + (k >= which)]
        size = np.clip(np.rint(np.abs(value) * (511 * np.sqrt(2))), 0, 511).astype(np.uint32)
        words = words << 10 | (value < 0).astype(np.uint32) << 9 | size
    return words.astype("<u4", copy=False)
