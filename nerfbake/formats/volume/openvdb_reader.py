"""An OpenVDB file from anywhere, version 222 to 224: grids of one or three floats, halves or doubles.

A node's values say their own size, so nodes are walked one after the other; values are unpacked once all masks are
known and what they need may be taken.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake.errors import InvalidFile, NerfbakeError, Problem, one_line
from nerfbake.formats.volume.frame import NAME, parse_frame
from nerfbake.formats.volume.openvdb_tree import Tree, read_tree
from nerfbake.formats.wire.openvdb_stream import ACTIVE_MASK, MAGIC, PACKED, VERSION, Stream
from nerfbake.formats.wire.openvdb_values import Kind
from nerfbake.scene.vdb import GRID_CLASSES, GridClass, VdbTree
from nerfbake.scene.volume import OctreeFrame, Volume

OLDEST = 222  # the first version whose nodes are stored as today
MAX_GRIDS = 1000
_SCALES, _AFFINE = ("UniformScaleMap", "ScaleMap"), "AffineMap"
_SCALES_AND_MOVES = ("UniformScaleTranslateMap", "ScaleTranslateMap")
_MAPS = (*_SCALES, *_SCALES_AND_MOVES, "TranslationMap", _AFFINE)
_TREES = {"float": (1, "<f4"), "double": (1, "<f8"), "vec3s": (3, "<f4"), "vec3d": (3, "<f8")}
_HALF = "_HalfFloat"
READABLE = "float, double, vec3s or vec3d, and their halves"
SEPARATOR = "\x1e"  # before the number that tells grids of one name apart


class _Header(NamedTuple):
    """What stands before a grid: its name, how many of that name stand before it, its type, whose tree it shares."""

    name: str
    number: int
    type: str
    parent: str
    start: int
    end: int

    @property
    def what(self) -> str:
        return f"grid {self.name[:80]!r}"


class _Grid(NamedTuple):
    header: _Header
    tree: VdbTree
    transform: npt.NDArray[np.float64]
    frame: OctreeFrame | None


def read_file(view: memoryview) -> Volume:
    """The file's grids; those of one name by their numbers. Raises InvalidFile, MemoryLimit."""
    stream = Stream(view)
    magic, version, _, _, offsets = stream.numbers("qIIIB", "the file's header")
    if magic != MAGIC:
        raise InvalidFile(
            Problem("the file", f"starts with {magic & 0xFFFFFFFF:08x}", f"{MAGIC:08x}, as .vdb files do")
        )
    if not OLDEST <= version <= VERSION:
        raise InvalidFile(Problem("the file", f"has version {version}", f"{OLDEST} to {VERSION}"))
    stream.take(36, "the UUID")
    stream.metadata()
    (count,) = stream.numbers("i", "the number of grids")
    if not 1 <= count <= MAX_GRIDS:
        raise InvalidFile(Problem("the file", f"has {count:,} grids", f"1 to {MAX_GRIDS:,}"))
    read: dict[str, _Grid] = {}
    unread: list[Problem] = []
    for _ in range(count):
        header, unique = _read_header(stream, seekable=bool(offsets))
        if (problem := _why_not(header, read)) is not None:
            if not offsets:
                raise InvalidFile(problem)  # nothing says where the next grid starts
            unread.append(problem)
            stream.at = header.end
            continue
        parent = read[header.parent] if header.parent else None  # '' is none, even where a grid before has no name
        grid = _read_grid(stream, header, parent, seekable=bool(offsets))
        # Grids of one name without numbers are told apart by their places.
        read[unique if unique not in read else f"{unique}{SEPARATOR}{len(read)}"] = grid
    if not read:
        raise InvalidFile(unread[0])
    if offsets and stream.at != len(view):
        raise InvalidFile(Problem("the file", f"goes on for {len(view) - stream.at:,} bytes", "the grids it counts"))
    return _volume(list(read.values()), unread)


def _volume(grids: list[_Grid], unread: list[Problem]) -> Volume:
    names = [grid.header.name for grid in grids]
    grids = sorted(grids, key=lambda grid: (names.index(grid.header.name), grid.header.number))
    first = grids[0].transform
    trees = []
    for grid in grids:
        own = None if grid.transform.tobytes() == first.tobytes() else grid.transform
        trees.append(replace(grid.tree, place=own))
    frame = next((grid.frame for grid in grids if grid.frame), None)
    return Volume(tuple(trees), first, frame, unread=tuple(unread))


def _read_header(stream: Stream, *, seekable: bool) -> tuple[_Header, str]:
    """What stands before the next grid, and its name with the number that OpenVDB gave it."""
    unique = stream.text("a grid's name")
    name, _, number = unique.partition(SEPARATOR)
    name = one_line(name)
    what = f"grid {name[:80]!r}"
    kind, parent = stream.text(what), stream.text(what)
    start, _, end = stream.numbers("3q", what)
    if seekable and (start != stream.at or not start < end <= len(stream.view)):
        found = f"stands at bytes {start:,} to {end:,}"
        raise InvalidFile(Problem(what, found, f"{stream.at:,} to {len(stream.view):,} at most"))
    place = int(number) if number.isascii() and number.isdecimal() and len(number) < 10 else 0
    return _Header(name, place, kind, parent, start, end), unique


def _why_not(header: _Header, read: dict[str, _Grid]) -> Problem | None:
    """Why a grid cannot be read, if it cannot."""
    if _kind_of(header.type) is None:
        return Problem(header.what, f"is a {one_line(header.type[:60])}", f"trees 5_4_3 of {READABLE}")
    if header.parent and header.parent not in read:
        return Problem(header.what, f"shares the voxels of {one_line(header.parent[:60])!r}", "a grid before it")
    return None


def _kind_of(type_name: str) -> Kind | None:
    """Tree_float_5_4_3_HalfFloat and its like."""
    half = type_name.endswith(_HALF)
    inner = type_name.removesuffix(_HALF).removeprefix("Tree_").removesuffix("_5_4_3")
    if inner not in _TREES or type_name != f"Tree_{inner}_5_4_3{_HALF * half}":
        return None
    channels, full = _TREES[inner]
    return Kind(channels, np.dtype("<f2" if half else full), np.dtype(full))


def _read_grid(stream: Stream, header: _Header, parent: _Grid | None, *, seekable: bool) -> _Grid:
    kind = _kind_of(header.type)
    assert kind is not None
    (flags,) = stream.numbers("I", header.what)
    if flags & ~(PACKED | ACTIVE_MASK):
        raise InvalidFile(Problem(header.what, f"has compression {flags}", "0 to 7: none, zip, active mask, blosc"))
    metadata = stream.metadata()
    transform = _read_map(stream)
    if parent is None:
        tree = read_tree(stream, kind, flags, header.what)
    else:
        shared = parent.tree
        active = np.ones(len(shared.values), bool) if shared.active is None else shared.active
        tree = Tree(shared.topology, shared.values, shared.background, active)
    if seekable and stream.at != header.end:
        raise InvalidFile(Problem(header.what, f"ends at byte {stream.at:,}", f"{header.end:,} as it says"))
    frame = parse_frame(metadata[NAME]) if NAME in metadata else None
    try:
        grid = VdbTree(
            header.name,
            tree.topology,
            tree.values,
            tree.background,
            _class_of(metadata.get("class", b"")),
            tree.active,
            stored="double" if kind.dtype == np.float64 else "",
        )
    except NerfbakeError as error:
        raise InvalidFile(error.what) from None
    return _Grid(header, grid, transform, frame)


def _class_of(text: bytes) -> GridClass:
    """What OpenVDB makes of a class: a word that it does not know is unknown."""
    return next((known for known in GRID_CLASSES if known.encode() == text.strip().lower()), "unknown")


def _read_map(stream: Stream) -> npt.NDArray[np.float64]:
    """(3, 4) from an index to the world."""
    kind = stream.text("the map")
    if kind not in _MAPS:
        raise InvalidFile(Problem("the map", f"is a {one_line(kind[:60])}", ", ".join(_MAPS)))
    if kind == _AFFINE:
        square = stream.array("<f8", 16, kind).reshape(4, 4)
        return np.ascontiguousarray(square[:, :3].T)
    moves = stream.array("<f8", 3, kind) if kind not in _SCALES else np.zeros(3)
    scale = stream.array("<f8", 15, kind)[:3] if kind != "TranslationMap" else np.ones(3)
    return np.column_stack([np.diag(scale), moves])
