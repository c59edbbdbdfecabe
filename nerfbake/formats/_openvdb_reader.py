"""An OpenVDB file from anywhere, version 222 to 224: float and 3-float grids of active voxels.

A node's values say their own size, so nodes are walked one after the other; values are unpacked once all masks are
known and what they need may be taken.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from nerfbake import memory
from nerfbake.errors import InvalidFile, Problem, one_line
from nerfbake.formats._openvdb_stream import ACTIVE_MASK, ALL_VALUES, MAGIC, PACKED, VERSION, Stream
from nerfbake.formats._openvdb_values import Kind, read_leaves, require_code
from nerfbake.formats._openvdb_writer import TYPES
from nerfbake.formats._vdb_frame import NAME, parse_frame
from nerfbake.kernels.bitmask import Words, popcount
from nerfbake.kernels.runs import rows_of_runs
from nerfbake.scene.vdb import VdbTopology, VdbTree
from nerfbake.scene.volume import OctreeFrame, Volume

OLDEST = 222  # the first version whose nodes are stored as today
MAX_GRIDS = 1000
_SCALES, _AFFINE = ("UniformScaleMap", "ScaleMap"), "AffineMap"
_SCALES_AND_MOVES = ("UniformScaleTranslateMap", "ScaleTranslateMap")
_MAPS = (*_SCALES, *_SCALES_AND_MOVES, "TranslationMap", _AFFINE)


KINDS = {name: Kind(channels, np.dtype(dtype)) for (channels, dtype), name in TYPES.items()}


def read_file(view: memoryview) -> Volume:
    """The file's grids. Raises InvalidFile, MemoryLimit."""
    stream = Stream(view)
    magic, version, _, _, offsets = stream.numbers("qIIIB", "the file's header")
    if magic != MAGIC or not OLDEST <= version <= VERSION or not offsets:
        raise InvalidFile(Problem("the file", f"has version {version}", f"{OLDEST} to {VERSION}, with grid offsets"))
    stream.take(36, "the UUID")
    stream.metadata()
    (count,) = stream.numbers("i", "the number of grids")
    if not 1 <= count <= MAX_GRIDS:
        raise InvalidFile(Problem("the file", f"has {count:,} grids", f"1 to {MAX_GRIDS:,}"))
    grids, transforms, frame = [], [], None
    for _ in range(count):
        grid, transform, own_frame = _read_grid(stream)
        grids.append(grid)
        transforms.append(transform)
        frame = frame or own_frame
    if any(transform.tobytes() != transforms[0].tobytes() for transform in transforms):
        raise InvalidFile(Problem("the file", "has grids of several transforms", "one transform for all"))
    return Volume(tuple(grids), transforms[0], frame)


def _read_grid(stream: Stream) -> tuple[VdbTree, npt.NDArray[np.float64], OctreeFrame | None]:
    # Behind a separator OpenVDB numbers the grids that share a name.
    name = one_line(stream.text("a grid's name").partition("\x1e")[0])
    what = f"grid {name[:80]!r}"
    type_name, parent = stream.text(what), stream.text(what)
    kind = KINDS.get(type_name)
    if kind is None or parent:
        raise InvalidFile(Problem(what, f"is a {(parent and 'copy') or one_line(type_name[:60])}", ", ".join(KINDS)))
    start, _, end = stream.numbers("3q", what)
    if start != stream.at or not start < end <= len(stream.view):
        found = f"stands at bytes {start:,} to {end:,}"
        raise InvalidFile(Problem(what, found, f"{stream.at:,} to {len(stream.view):,} at most"))
    (flags,) = stream.numbers("I", what)
    if flags & ~(PACKED | ACTIVE_MASK):
        raise InvalidFile(Problem(what, f"has compression {flags}", "0 to 7: none, zip, active mask, blosc"))
    metadata = stream.metadata()
    transform = _read_map(stream)
    stored, background = _read_masks(stream, kind, flags, what)
    memory.hold(what, stored.m * kind.width)
    values = read_leaves(stream, stored.leaf_mask, kind, flags, what)
    if stream.at != end:
        raise InvalidFile(Problem(what, f"ends at byte {stream.at:,}", f"{end:,} as it says"))
    topology, order = stored.in_order()
    for problem in topology.structure_problems():
        raise InvalidFile(problem)
    if (np.diff(order) < 0).any():
        values = values[rows_of_runs(popcount(stored.leaf_mask), order)]
    frame = parse_frame(metadata[NAME]) if NAME in metadata else None
    return VdbTree(name, topology, values, background), transform, frame


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


# -- the tree --------------------------------------------------------------------------------------------------
def _read_masks(stream: Stream, kind: Kind, flags: int, what: str) -> tuple[VdbTopology, npt.NDArray[np.float32]]:
    """The tree with its tiles in the file's order, and the background."""
    (buffers,) = stream.numbers("I", what)
    if buffers != 1:
        raise InvalidFile(Problem(what, f"has {buffers:,} buffers a leaf", "1"))
    background = stream.array("<f4", kind.channels, what).astype(np.float32)
    tiles, children = stream.numbers("II", what)
    for _ in range(tiles):
        *_, active = stream.numbers(f"3i{kind.channels}fB", what)
        _require_no_tile(bool(active), what)
    origins, uppers, lowers, leaves = [], [], [], []
    for _ in range(children):
        origins.append(stream.array("<i4", 3, what))
        upper = _read_node(stream, 4096, kind, flags, what)
        uppers.append(upper)
        for _ in range(int(popcount(upper[None])[0])):
            lower = _read_node(stream, 512, kind, flags, what)
            lowers.append(lower)
            leaves.append(stream.array("<u8", 8 * int(popcount(lower[None])[0]), what))
    origin = np.array(origins, np.int32).reshape(-1, 3)
    return VdbTopology(origin, _stacked(uppers, 512), _stacked(lowers, 64), _stacked(leaves, 8)), background


def _read_node(stream: Stream, size: int, kind: Kind, flags: int, what: str) -> Words:
    """An inner node's child mask; its values are background, since it may have no active tiles."""
    children = stream.array("<u8", size // 8, what)
    _require_no_tile(bool(stream.array("<u8", size // 8, what).any()), what)
    code = _read_code(stream, size, kind, what)
    count = size * 8 if code == ALL_VALUES or not flags & ACTIVE_MASK else 0
    # An empty array of halves has not even a size.
    if count or kind.dtype != np.float16:
        stream.skip_packed(count * kind.width, flags, what)
    return children


def _read_code(stream: Stream, mask_size: int, kind: Kind, what: str) -> int:
    """How a node's values are stored, with the inactive ones read over."""
    (code,) = stream.numbers("B", what)
    require_code(code, what)
    stream.take(kind.beside(code, mask_size), what)
    return int(code)


def _require_no_tile(active: bool, what: str) -> None:
    if active:
        raise InvalidFile(Problem(what, "has active tiles", "active voxels only"))


def _stacked(rows: list[Words], width: int) -> Words:
    return np.concatenate(rows or [np.zeros(0, np.uint64)]).astype(np.uint64).reshape(-1, width)
