"""Read OpenVDB files of any program, versions 222 to 225: grids of one or three floats, halves or doubles.

A tree is stored as masks and tiles, node by node, then the values of all leaves. The size of a node's values is only
stored with the values, so nodes are parsed sequentially. Values are decompressed after all masks have been read and the
memory limit has been checked.
"""

from __future__ import annotations

import re
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake import memory
from nerfbake.errors import InvalidFile, NerfbakeError, Problem, one_line
from nerfbake.formats.volume.frame import NAME, parse_frame
from nerfbake.formats.wire.openvdb import (
    ACTIVE_MASK,
    MAGIC,
    PACKED,
    Stream,
    ValueType,
    read_leaves,
    read_slots,
)
from nerfbake.formats.wire.vdb_values import StoredValues
from nerfbake.kernels.arrays import Words
from nerfbake.kernels.maths.elementary import cast
from nerfbake.kernels.vdb.bitmask import popcount
from nerfbake.scene.vdb import GRID_CLASSES, GridClass, VdbTree
from nerfbake.scene.vdb_topology import VdbTiles, VdbTopology
from nerfbake.scene.volume import OctreeFrame, Volume


class OpenVdbGrid(NamedTuple):
    """A grid without its name and transform; the fields are those of scene.vdb.VdbTree."""

    topology: VdbTopology
    values: npt.NDArray[Any]
    background: npt.NDArray[np.float32]
    active: npt.NDArray[np.bool_]


def read_tree(stream: Stream, kind: ValueType, flags: int, what: str) -> OpenVdbGrid:
    """Read the tree of one grid. Raises InvalidFile, MemoryLimit."""
    nodes = _Nodes(stream, kind, flags, what)
    leaves = read_leaves(stream, nodes.leaf_mask, kind, flags, nodes.background, what)
    parts = [leaves, *nodes.tiles]
    tiles = VdbTiles(nodes.tiles[0].mask, nodes.tiles[1].mask, nodes.tile_origin)
    stored = VdbTopology(nodes.root_origin, nodes.upper_mask, nodes.lower_mask, leaves.mask, tiles)
    for problem in stored.mask_problems():
        raise InvalidFile(problem)
    values, active = (np.concatenate([getattr(part, name) for part in parts]) for name in ("values", "active"))
    topology, rows = stored.in_order()
    for problem in topology.structure_problems():
        raise InvalidFile(problem)
    if rows is not None:
        values, active = values[rows], active[rows]
    return OpenVdbGrid(topology, values, cast(nodes.background, np.float32), active)


class _Nodes:
    """Masks and tiles of all nodes, in the order of the file."""

    def __init__(self, stream: Stream, kind: ValueType, flags: int, what: str) -> None:
        self._stream, self._kind, self._flags, self._what = stream, kind, flags, what
        (buffers,) = stream.numbers("I", what)
        if buffers != 1:
            raise InvalidFile(Problem(what, f"has {buffers:,} buffers per leaf", "1"))
        self.background = kind.read(stream.take(kind.channels * kind.full.itemsize, what), kind.full)[0]
        tiles, children = stream.numbers("II", what)
        root, self.tile_origin = self._root_tiles(tiles)
        origins, masks = [], (list[Words](), list[Words](), list[Words]())
        uppers: list[StoredValues | None] = []
        lowers: list[StoredValues | None] = []
        for _ in range(children):
            origins.append(stream.array("<i4", 3, what))
            upper = self._inner(4096, uppers)
            masks[0].append(upper)
            for _ in range(int(popcount(upper[None])[0])):
                lower = self._inner(512, lowers)
                masks[1].append(lower)
                masks[2].append(stream.array("<u8", 8 * int(popcount(lower[None])[0]), what))
        self.root_origin = np.array(origins, np.int32).reshape(-1, 3)
        self.upper_mask, self.lower_mask, self.leaf_mask = map(_stacked, masks, (512, 64, 8))
        self.tiles = [self._joined(lowers, 64), self._joined(uppers, 512), root]

    def _root_tiles(self, count: int) -> tuple[StoredValues, npt.NDArray[np.int32]]:
        kind = self._kind
        dtype = np.dtype(
            [("origin", "<i4", 3), ("value", kind.full.newbyteorder("<"), kind.channels), ("active", "u1")]
        )
        tiles = np.frombuffer(self._stream.take(count * dtype.itemsize, self._what), dtype)
        values = kind.read(np.ascontiguousarray(tiles["value"]).data, kind.full)
        active = tiles["active"] != 0
        stored = active | (values != self.background).any(axis=1)
        origins = tiles["origin"][stored].astype(np.int32)
        return StoredValues(np.zeros((0, 0), np.uint64), values[stored], active[stored]), origins

    def _inner(self, size: int, found: list[StoredValues | None]) -> Words:
        """Read an inner node: return its child mask (`size` bytes), append its tiles to `found`."""
        children = self._stream.array("<u8", size // 8, self._what)
        active = self._stream.array("<u8", size // 8, self._what)
        tiles = read_slots(self._stream, children, active, self._kind, self._flags, self.background, self._what)
        if tiles is not None:
            memory.hold(self._what, tiles.values.nbytes)
        found.append(tiles)
        return children

    def _joined(self, nodes: list[StoredValues | None], width: int) -> StoredValues:
        """Concatenate the tiles of all nodes of a level."""
        mask = np.zeros((len(nodes), width), np.uint64)
        values, active = [np.zeros((0, self._kind.channels), self._kind.held)], [np.zeros(0, bool)]
        for row, node in enumerate(nodes):
            if node is not None:
                mask[row] = node.mask
                values.append(node.values)
                active.append(node.active)
        return StoredValues(mask, np.concatenate(values), np.concatenate(active))


def _stacked(rows: list[Words], width: int) -> Words:
    return np.concatenate(rows or [np.zeros(0, np.uint64)]).astype(np.uint64).reshape(-1, width)


# The first version with the current node layout, and the last: 225 (OpenVDB 13) adds grids of type half alone.
OLDEST, NEWEST = 222, 225
MAX_GRIDS = 1000
_SCALES, _AFFINE = ("UniformScaleMap", "ScaleMap"), "AffineMap"
_SCALES_AND_MOVES = ("UniformScaleTranslateMap", "ScaleTranslateMap")
_MAPS = (*_SCALES, *_SCALES_AND_MOVES, "TranslationMap", _AFFINE)
_TREES = {"float": (1, "<f4"), "double": (1, "<f8"), "vec3s": (3, "<f4"), "vec3d": (3, "<f8")}
_HALF = "_HalfFloat"
_HALVES = re.compile(r"Tree_(half|vec[234]h)_5_4_3")  # native halves, which no released library could check
READABLE = "float, double, vec3s or vec3d, and their halves"
SEPARATOR = "\x1e"  # precedes the number of a grid whose name is not unique


class _Header(NamedTuple):
    """The header of a grid: name, number among the grids of that name, type, and the grid whose tree it shares."""

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
    """Read all grids of a file; grids of the same name are sorted by number. Raises InvalidFile, MemoryLimit."""
    stream = Stream(view)
    magic, version, _, _, offsets = stream.numbers("qIIIB", "the file's header")
    if magic != MAGIC:
        raise InvalidFile(
            Problem("the file", f"starts with {magic & 0xFFFFFFFF:08x}", f"{MAGIC:08x}, as .vdb files do")
        )
    if not OLDEST <= version <= NEWEST:
        raise InvalidFile(Problem("the file", f"has version {version}", f"{OLDEST} to {NEWEST}"))
    if offsets > 1:
        raise InvalidFile(Problem("the file", f"has {offsets} as its flag of offsets", "0 or 1"))
    stream.take(36, "the UUID")
    stream.metadata()
    (count,) = stream.numbers("i", "the number of grids")
    if not 1 <= count <= MAX_GRIDS:
        raise InvalidFile(Problem("the file", f"has {count:,} grids", f"1 to {MAX_GRIDS:,}"))
    read: dict[str, _Grid] = {}
    unread: list[Problem] = []
    for _ in range(count):
        header, unique = _read_header(stream, seekable=bool(offsets))
        grid: _Grid | Problem | None = _problem_of(header, read)
        if grid is None:
            # '' means no parent, even if an earlier grid has no name.
            parent = read[header.parent] if header.parent else None
            grid = _read_grid(stream, header, parent, seekable=bool(offsets))
        if isinstance(grid, Problem):
            if not offsets:
                raise InvalidFile(grid)  # without offsets the start of the next grid is unknown
            unread.append(grid)
            stream.at = header.end
            continue
        # Grids of the same name without numbers are distinguished by their order in the file.
        read[unique if unique not in read else f"{unique}{SEPARATOR}{len(read)}"] = grid
    if not read:
        raise InvalidFile(unread[0])
    if offsets and stream.at != len(view):
        raise InvalidFile(Problem("the file", f"has {len(view) - stream.at:,} bytes after the last grid", "none"))
    return _volume(list(read.values()), unread)


def _volume(grids: list[_Grid], unread: list[Problem]) -> Volume:
    names = [grid.header.name for grid in grids]
    grids = sorted(grids, key=lambda grid: (names.index(grid.header.name), grid.header.number))
    first = grids[0].transform
    trees = []
    for grid in grids:
        place = None if grid.transform.tobytes() == first.tobytes() else grid.transform
        trees.append(replace(grid.tree, place=place))
    frame = next((grid.frame for grid in grids if grid.frame), None)
    return Volume(tuple(trees), first, frame, unread=tuple(unread))


def _read_header(stream: Stream, *, seekable: bool) -> tuple[_Header, str]:
    """Read the header of the next grid. Return it with the unique name: the name and OpenVDB's number."""
    unique = stream.text("a grid's name")
    name, _, number = unique.partition(SEPARATOR)
    name = one_line(name)
    what = f"grid {name[:80]!r}"
    kind, parent = stream.text(what), stream.text(what)
    start, _, end = stream.numbers("3q", what)
    if seekable and (start != stream.at or not start < end <= len(stream.view)):
        found = f"is at bytes {start:,} to {end:,}"
        raise InvalidFile(Problem(what, found, f"{stream.at:,} to {len(stream.view):,} at most"))
    place = int(number) if number.isascii() and number.isdecimal() and len(number) < 10 else 0
    return _Header(name, place, kind, parent, start, end), unique


def _problem_of(header: _Header, read: dict[str, _Grid]) -> Problem | None:
    """Return the reason why a grid cannot be read, or None."""
    if _HALVES.fullmatch(header.type):
        found = f"is a {header.type}, a grid of halves as OpenVDB 13 writes it"
        return Problem(header.what, found, "floats saved as halves (Tree_float_5_4_3_HalfFloat), or floats")
    if _kind_of(header.type) is None:
        return Problem(header.what, f"is a {one_line(header.type[:60])}", f"trees 5_4_3 of {READABLE}")
    if header.parent and header.parent not in read:
        return Problem(header.what, f"shares the voxels of {one_line(header.parent[:60])!r}", "a grid before it")
    return None


def _kind_of(type_name: str) -> ValueType | None:
    """Parse a type name such as Tree_float_5_4_3_HalfFloat. Return None if the type is not supported."""
    half = type_name.endswith(_HALF)
    inner = type_name.removesuffix(_HALF).removeprefix("Tree_").removesuffix("_5_4_3")
    if inner not in _TREES or type_name != f"Tree_{inner}_5_4_3{_HALF * half}":
        return None
    channels, full = _TREES[inner]
    return ValueType(channels, np.dtype("<f2" if half else full), np.dtype(full))


def _read_grid(stream: Stream, header: _Header, parent: _Grid | None, *, seekable: bool) -> _Grid | Problem:
    """Return the grid, or the problem if its map is not supported."""
    kind = _kind_of(header.type)
    assert kind is not None
    (flags,) = stream.numbers("I", header.what)
    if flags & ~(PACKED | ACTIVE_MASK):
        raise InvalidFile(Problem(header.what, f"has compression {flags}", "0 to 7: none, zip, active mask, blosc"))
    metadata = stream.metadata()
    transform = _read_map(stream, header.what)
    if isinstance(transform, Problem):
        return transform
    if parent is None:
        tree = read_tree(stream, kind, flags, header.what)
    else:
        shared = parent.tree
        active = np.ones(len(shared.values), bool) if shared.active is None else shared.active
        tree = OpenVdbGrid(shared.topology, shared.values, shared.background, active)
    if seekable and stream.at != header.end:
        raise InvalidFile(
            Problem(header.what, f"ends at byte {stream.at:,}", f"{header.end:,}, as its header declares")
        )
    frame = parse_frame(metadata[NAME]) if NAME in metadata else None
    try:
        grid = VdbTree(
            header.name,
            tree.topology,
            tree.values,
            tree.background,
            _class_of(bytes(metadata.get("class", b""))),
            tree.active,
            stored="double" if kind.dtype == np.float64 else "",
        )
    except NerfbakeError as error:
        raise InvalidFile(error.what) from None
    return _Grid(header, grid, transform, frame)


def _class_of(text: bytes) -> GridClass:
    """Parse a grid class as OpenVDB does: any other word is 'unknown'."""
    return next((known for known in GRID_CLASSES if known.encode() == text.strip().lower()), "unknown")


def _read_map(stream: Stream, what: str) -> npt.NDArray[np.float64] | Problem:
    """Read the transform from indices to world coordinates, (3, 4)."""
    kind = stream.text("the map")
    if kind not in _MAPS:
        return Problem(f"{what}: the map", f"is a {one_line(kind[:60])}", ", ".join(_MAPS))
    if kind == _AFFINE:
        square = stream.array("<f8", 16, kind).reshape(4, 4)
        return np.ascontiguousarray(square[:, :3].T)
    moves = stream.array("<f8", 3, kind) if kind not in _SCALES else np.zeros(3)
    scale = stream.array("<f8", 15, kind)[:3] if kind != "TranslationMap" else np.ones(3)
    return np.column_stack([np.diag(scale), moves])
