"""VDB grids as plain NumPy arrays (.vdb.npz), for shaders of one's own: schemas/vdb_npz.md tells every key.

Grids that have the same voxels share one tree. Its masks come as 32-bit words with their ranks, so that a shader goes
down three levels with the same three lines and needs no 64-bit numbers:

    child = rank[node, slot >> 5] + bitCount(mask[node, slot >> 5] & (1 << (slot & 31)) - 1)

The ranks of leaves count from 1: row 0 of each table is the background, as in NanoVDB's index grids.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from nerfbake.errors import InvalidFile, InvalidScene, Problem, one_line
from nerfbake.formats._npz_reader import ZIP_MAGIC, NpzReader
from nerfbake.formats._npz_writer import write_npz
from nerfbake.formats._vdb_frame import NAME, frame_text, parse_frame
from nerfbake.kernels.bitmask import Words, exclusive_sum
from nerfbake.kernels.topology import place
from nerfbake.scene.vdb import IndexGrid, VdbTopology, VdbTree
from nerfbake.scene.volume import Volume

VERSION = 1
MAX_GRIDS = 100  # each may bring nine members, and NpzReader takes a thousand
MAX_NAME = 9_999  # characters that it takes in a text
CLASSES = ("fog volume", "unknown", "index")  # what OpenVDB calls densities and colours; and IndexGrid
_LEVELS = (("upper", 512, 0), ("lower", 64, 0), ("leaf", 8, 1))  # 64-bit words of a mask, and the first rank


def recognise(head: bytes) -> bool:
    """True for the first bytes of the archives that encode() writes."""
    return head[:4] in ZIP_MAGIC and b"vdb_version.npy" in head[:64]


def encode(volume: Volume) -> Iterator[bytes | memoryview]:
    """The archive in pieces. Raises InvalidScene for more grids or longer names than decode() takes."""
    names = [grid.name for grid in volume.grids]
    if len(names) > MAX_GRIDS:
        raise InvalidScene(Problem("a .vdb.npz", f"would hold {len(names):,} grids", f"{MAX_GRIDS} at most"))
    if (longest := max(map(len, names))) > MAX_NAME:
        raise InvalidScene(Problem("a grid's name", f"is {longest:,} characters long", f"{MAX_NAME:,} in a .vdb.npz"))
    trees: list[VdbTopology] = []
    numbers = [_number_of(grid.topology, trees) for grid in volume.grids]
    arrays: dict[str, npt.ArrayLike] = {
        "vdb_version": np.int64(VERSION),
        "transform": volume.transform,
        "grid_name": np.array(names),
        "grid_class": np.array([_class_of(grid) for grid in volume.grids]),
        "grid_tree": np.array(numbers, np.int32),
    }
    if volume.frame is not None:
        arrays[NAME] = np.frombuffer(frame_text(volume.frame).encode(), np.uint8)
    for k, tree in enumerate(trees):
        arrays[f"tree_{k}_root_origin"] = tree.root_origin
        for level, _, first in _LEVELS:
            words = _words32(getattr(tree, f"{level}_mask"))
            arrays[f"tree_{k}_{level}_mask"], arrays[f"tree_{k}_{level}_rank"] = words, _ranks(words, first)
    for k, grid in enumerate(volume.grids):
        arrays[f"grid_{k}_table"] = grid.table if isinstance(grid, IndexGrid) else _table(grid)
    return write_npz(arrays)


def decode(view: memoryview) -> Volume:
    npz = NpzReader(view)
    npz.require("vdb_version", "transform", "grid_name", "grid_class", "grid_tree")
    if (version := npz.scalar("vdb_version")) != VERSION:
        raise InvalidFile(Problem("vdb_version", f"is {version}", f"{VERSION}"))
    names = npz.shaped("grid_name", "U", (None,))
    if not 1 <= len(names) <= MAX_GRIDS:
        raise InvalidFile(Problem("grid_name", f"has {len(names):,} names", f"1 to {MAX_GRIDS}"))
    classes = npz.shaped("grid_class", "U", (len(names),)).tolist()
    numbers = npz.shaped("grid_tree", "iu", (len(names),)).tolist()
    trees = {k: _read_tree(npz, k) for k in sorted(set(numbers))}
    grids = tuple(
        _read_grid(npz, k, one_line(name), grid_class, trees[number])
        for k, (name, grid_class, number) in enumerate(zip(names.tolist(), classes, numbers, strict=True))
    )
    frame = parse_frame(npz.shaped(NAME, "u", (None,)).astype(np.uint8).tobytes()) if NAME in npz else None
    return Volume(grids, npz.shaped("transform", "f", (3, 4)).astype(np.float64), frame)


def _read_grid(npz: NpzReader, k: int, name: str, grid_class: str, tree: VdbTopology) -> VdbTree | IndexGrid:
    if grid_class not in CLASSES:
        raise InvalidFile(Problem(f"grid_class[{k}]", f"is {one_line(grid_class[:60])!r}", ", ".join(CLASSES)))
    table = npz.shaped(f"grid_{k}_table", "f", (None, None))
    if grid_class == "index":
        return IndexGrid(name, tree, table)
    if not len(table):
        raise InvalidFile(Problem(f"grid_{k}_table", "has no rows", "the background, then a row a voxel"))
    return VdbTree(name, tree, table[1:], table[0].astype(np.float32))


def _class_of(grid: VdbTree | IndexGrid) -> Literal["fog volume", "unknown", "index"]:
    if isinstance(grid, IndexGrid):
        return "index"
    return "fog volume" if grid.values.shape[1] == 1 else "unknown"


def _table(grid: VdbTree) -> npt.NDArray[Any]:
    """(m + 1, c) the background, rounded as the values are, and the active voxels."""
    return np.concatenate([grid.background[None].astype(grid.values.dtype), grid.values])


# -- trees -----------------------------------------------------------------------------------------------------
def _number_of(tree: VdbTopology, trees: list[VdbTopology]) -> int:
    """Which of the trees it is; it is put behind them where it is none."""
    for k, other in enumerate(trees):
        if tree.same_as(other):
            return k
    trees.append(tree)
    return len(trees) - 1


def _read_tree(npz: NpzReader, k: int) -> VdbTopology:
    masks = []
    for level, width, first in _LEVELS:
        mask, rank = (f"tree_{k}_{level}_{what}" for what in ("mask", "rank"))
        words = npz.shaped(mask, "u", (None, 2 * width))
        if words.dtype != np.uint32:
            raise InvalidFile(Problem(mask, f"has dtype {words.dtype}", "uint32"))
        ranks, right = npz.shaped(rank, "u", words.shape), _ranks(words, first)
        if (wrong := ranks != right).any():
            at = np.unravel_index(int(np.argmax(wrong)), wrong.shape)
            found = f"is {ranks[at]}"
            raise InvalidFile(Problem(place(rank, at), found, f"{right[at]}, by the bits set before that word"))
        masks.append(np.ascontiguousarray(words, "<u4").view("<u8").astype(np.uint64))
    return VdbTopology(npz.shaped(f"tree_{k}_root_origin", "i", (None, 3)), *masks)


def _words32(masks: Words) -> npt.NDArray[np.uint32]:
    """(p, 2 w) the same bits: slot s is bit s & 31 of word s >> 5."""
    return masks.astype("<u8", copy=False).view("<u4")


def _ranks(words: npt.NDArray[np.uint32], first: int) -> npt.NDArray[np.uint32]:
    """(p, 2 w) the bits set in all words before each, and `first`."""
    counts = np.bitwise_count(words).astype(np.int64).reshape(-1)
    return (exclusive_sum(counts) + first).astype(np.uint32).reshape(words.shape)
