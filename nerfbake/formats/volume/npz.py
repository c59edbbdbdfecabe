"""Read and write VDB grids as NumPy arrays (.vdb.npz), for custom shaders. All keys: schemas/vdb_npz.md.

Grids with the same voxels share one tree. Its masks are 32-bit words with ranks, so a shader descends all three levels
with the same three lines, without 64-bit integers:

    child = rank[node, slot >> 5] + bitCount(mask[node, slot >> 5] & (1 << (slot & 31)) - 1)

Leaf ranks start at 1: row 0 of each table is the background, as in NanoVDB's index grids. Version 2 adds tiles,
inactive values, transforms of single grids and level sets, which only occur in grids of other programs.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import numpy.typing as npt

from nerfbake.errors import InvalidFile, InvalidScene, Problem, one_line
from nerfbake.formats.volume.frame import NAME, frame_text, parse_frame
from nerfbake.formats.wire.npz import NpzReader, StreamedArray, write_npz
from nerfbake.formats.wire.zip_reader import npz_keys
from nerfbake.kernels.arrays import Words
from nerfbake.kernels.maths.elementary import cast
from nerfbake.kernels.soundness import place
from nerfbake.kernels.vdb.bitmask import exclusive_sum, popcount
from nerfbake.scene.vdb import GRID_CLASSES, IndexGrid, VdbTree
from nerfbake.scene.vdb_topology import VdbTiles, VdbTopology
from nerfbake.scene.volume import Volume

DEFAULT_GRIDS = ("density", "Cd")
FIELD_GRIDS = ("index",)
KEEPS_HALVES = True
HALF_NOTE = None
VERSION, FOREIGN = 1, 2  # FOREIGN: files with grids of other programs that version 1 cannot represent
MAX_GRIDS = 100  # each grid may have nine members, and NpzReader accepts a thousand
MAX_NAME = 9_999  # characters that NpzReader accepts in a string
INDEX = "index"  # grid class of an IndexGrid; the other classes are OpenVDB's
_LEVELS = (("upper", 512, 0), ("lower", 64, 0), ("leaf", 8, 1))  # 64-bit words of a mask, and the first rank


def recognise(view: memoryview) -> bool:
    """Return True for an archive with a vdb_version."""
    return "vdb_version" in npz_keys(view)


def require_grids(grids: tuple[str, ...], *, half: bool) -> None:
    """Accept all grids, in any combination, also as float16."""


def encode(volume: Volume) -> Iterator[bytes | memoryview]:
    """Yield the archive in chunks. Raises InvalidScene for more grids or longer names than decode() accepts."""
    names = [grid.name for grid in volume.grids]
    if len(names) > MAX_GRIDS:
        raise InvalidScene(Problem("a .vdb.npz", f"would contain {len(names):,} grids", f"{MAX_GRIDS} at most"))
    if (longest := max(map(len, names))) > MAX_NAME:
        raise InvalidScene(Problem("a grid's name", f"is {longest:,} characters long", f"{MAX_NAME:,} in a .vdb.npz"))
    trees: list[VdbTopology] = []
    numbers = [_number_of(grid.topology, trees) for grid in volume.grids]
    arrays: dict[str, npt.ArrayLike | StreamedArray] = {
        "vdb_version": np.int64(FOREIGN if any(map(_is_foreign, volume.grids)) else VERSION),
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
        arrays |= _tile_arrays(tree, k)
    for k, grid in enumerate(volume.grids):
        arrays[f"grid_{k}_table"] = StreamedArray(grid.table_rows) if isinstance(grid, IndexGrid) else _table(grid)
        if isinstance(grid, VdbTree) and grid.active is not None:
            arrays[f"grid_{k}_active"] = grid.active.astype(np.uint8)
        if isinstance(grid, VdbTree) and grid.place is not None:
            arrays[f"grid_{k}_transform"] = grid.place
    return write_npz(arrays)


def decode(view: memoryview) -> Volume:
    npz = NpzReader(view)
    npz.require("vdb_version", "transform", "grid_name", "grid_class", "grid_tree")
    if (version := npz.scalar("vdb_version")) not in (VERSION, FOREIGN):
        raise InvalidFile(Problem("vdb_version", f"is {version}", f"{VERSION}, {FOREIGN}"))
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
    return Volume(grids, cast(npz.shaped("transform", "f", (3, 4)), np.float64), frame)


def _read_grid(npz: NpzReader, k: int, name: str, grid_class: str, tree: VdbTopology) -> VdbTree | IndexGrid:
    table = npz.shaped(f"grid_{k}_table", "f", (None, None))
    if grid_class == INDEX:
        return IndexGrid(name, tree, table)
    known = next((known for known in GRID_CLASSES if known == grid_class), None)
    if known is None:
        allowed = ", ".join((*GRID_CLASSES, INDEX))
        raise InvalidFile(Problem(f"grid_class[{k}]", f"is {one_line(grid_class[:60])!r}", allowed))
    if not len(table):
        raise InvalidFile(Problem(f"grid_{k}_table", "has no rows", "the background, then one row per voxel"))
    active, transform = None, None
    if (key := f"grid_{k}_active") in npz:
        active = npz.shaped(key, "u", (len(table) - 1,)) != 0
    if (key := f"grid_{k}_transform") in npz:
        transform = cast(npz.shaped(key, "f", (3, 4)), np.float64)
    return VdbTree(name, tree, table[1:], cast(table[0], np.float32), known, active, transform)


def _class_of(grid: VdbTree | IndexGrid) -> str:
    return INDEX if isinstance(grid, IndexGrid) else str(grid.grid_class)


def _is_foreign(grid: VdbTree | IndexGrid) -> bool:
    """Return whether version 1 cannot represent the grid."""
    if isinstance(grid, IndexGrid):
        return False
    plain = grid.active is None and grid.place is None and grid.topology.tiles is None
    return not plain or grid.grid_class in ("level set", "staggered")


def _table(grid: VdbTree) -> npt.NDArray[Any]:
    """Return the table (m + 1, c): the background, rounded to the dtype of the values, then the voxels."""
    return np.concatenate([grid.background[None].astype(grid.values.dtype), grid.values])


# -- trees -----------------------------------------------------------------------------------------------------
def _number_of(tree: VdbTopology, trees: list[VdbTopology]) -> int:
    """Return the index of a tree in `trees`; append it if it is new."""
    for k, other in enumerate(trees):
        if tree.same_as(other):
            return k
    trees.append(tree)
    return len(trees) - 1


def _read_tree(npz: NpzReader, k: int) -> VdbTopology:
    masks = [_read_mask(npz, f"tree_{k}_{level}_mask", f"tree_{k}_{level}_rank", *rest) for level, *rest in _LEVELS]
    upper, lower, leaf = masks
    origin = npz.shaped(f"tree_{k}_root_origin", "i", (None, 3))
    return VdbTopology(origin, upper, lower, leaf, _read_tiles(npz, k, upper, lower, leaf))


def _read_tiles(npz: NpzReader, k: int, upper: Words, lower: Words, leaf: Words) -> VdbTiles | None:
    if f"tree_{k}_root_tile" not in npz:
        return None
    rows, masks = 1 + int(popcount(leaf).sum()), []
    for level, like in (("lower", lower), ("upper", upper)):
        masks.append(_read_mask(npz, f"tree_{k}_{level}_tile", f"tree_{k}_{level}_tile_rank", like.shape[1], rows))
        if masks[-1].shape != like.shape:
            found = f"has {len(masks[-1]):,} rows"
            raise InvalidFile(Problem(f"tree_{k}_{level}_tile", found, f"{len(like):,}, as the mask of the level"))
        rows += int(popcount(masks[-1]).sum())
    return VdbTiles(masks[0], masks[1], npz.shaped(f"tree_{k}_root_tile", "i", (None, 3)))


def _tile_arrays(tree: VdbTopology, k: int) -> dict[str, npt.ArrayLike | StreamedArray]:
    if tree.tiles is None:
        return {}
    lower, upper = _words32(tree.tiles.lower_mask), _words32(tree.tiles.upper_mask)
    first = 1 + tree.m
    return {
        f"tree_{k}_root_tile": tree.tiles.root_origin,
        f"tree_{k}_upper_tile": upper,
        f"tree_{k}_upper_tile_rank": _ranks(upper, first + tree.tile_counts[0]),
        f"tree_{k}_lower_tile": lower,
        f"tree_{k}_lower_tile_rank": _ranks(lower, first),
    }


def _read_mask(npz: NpzReader, mask: str, rank: str, width: int, first: int) -> Words:
    words = npz.shaped(mask, "u", (None, 2 * width))
    if words.dtype != np.uint32:
        raise InvalidFile(Problem(mask, f"has dtype {words.dtype}", "uint32"))
    ranks, right = npz.shaped(rank, "u", words.shape), _ranks(words, first)
    if (wrong := ranks != right).any():
        at = np.unravel_index(int(np.argmax(wrong)), wrong.shape)
        found = f"is {ranks[at]}"
        raise InvalidFile(Problem(place(rank, at), found, f"{right[at]}, the number of bits set before that word"))
    return np.ascontiguousarray(words, "<u4").view("<u8").astype(np.uint64)


def _words32(masks: Words) -> npt.NDArray[np.uint32]:
    """Return the masks as 32-bit words, (p, 2 w): slot s is bit s & 31 of word s >> 5."""
    return masks.astype("<u8", copy=False).view("<u4")


def _ranks(words: npt.NDArray[np.uint32], first: int) -> npt.NDArray[np.uint32]:
    """Return the rank of each word, (p, 2 w): the number of bits set in all words before it, plus `first`."""
    counts = np.bitwise_count(words).astype(np.int64).reshape(-1)
    return (exclusive_sum(counts) + first).astype(np.uint32).reshape(words.shape)
