"""Write one grid in NanoVDB's layout, without the file header. Every section starts at a multiple of 32 bytes.

GridData 672 | TreeData 64 | root, tiles 32 each | upper nodes | lower nodes | leaves | blind structs | blind data

Nodes contain the box of the active voxels below them, and their minimum, maximum, mean and standard deviation.
"""

from __future__ import annotations

import zlib
from math import prod
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake.errors import InvalidScene, Problem
from nerfbake.formats.volume.frame import NAME, frame_text
from nerfbake.formats.wire import nanovdb as nano
from nerfbake.kernels.arrays import Ints, Words
from nerfbake.kernels.maths.affine import inverse, transform_points
from nerfbake.kernels.vdb.bitmask import (
    RunSpread,
    exclusive_sum,
    popcount,
    prefix_counts,
    reduce_runs,
    root_keys,
    slots_of,
    spread_of,
    spread_over,
    spread_with,
)
from nerfbake.scene.rows import Rows
from nerfbake.scene.vdb import IndexGrid, VdbTree
from nerfbake.scene.vdb_topology import Cubes, VdbTopology
from nerfbake.scene.volume import Volume, edges_of

Nodes = npt.NDArray[Any]


def set_boxes(active: VdbTopology, upper: Nodes, lower: Nodes) -> npt.NDArray[np.int32]:
    """Write the boxes of active voxels and tiles into the nodes. Return the box of the whole tree."""
    low, high = active.leaf_boxes
    boxes = np.concatenate([low, high], axis=1).astype(np.int32)
    boxes[~active.leaf_mask.any(axis=1)] = nano.EMPTY_BOX
    cubes = iter(active.tile_cubes)
    for nodes, name in ((lower, "lower_mask"), (upper, "upper_mask")):
        boxes = _boxes(boxes, popcount(getattr(active, name)))
        if active.tiles is not None:
            boxes = _around(boxes, _boxes(_boxes_of(next(cubes)), popcount(getattr(active.tiles, name))))
        nodes["box"] = boxes
    outer = np.concatenate([boxes, *(_boxes_of(cube) for cube in cubes)])
    whole: npt.NDArray[np.int32] = _boxes(outer, np.array([len(outer)]))[0]
    return whole


def _boxes_of(cubes: Cubes) -> npt.NDArray[np.int32]:
    return np.concatenate([cubes.low, cubes.low + np.int32(cubes.edge - 1)], axis=1)


def _around(one: npt.NDArray[np.int32], other: npt.NDArray[np.int32]) -> npt.NDArray[np.int32]:
    low = np.minimum(one[:, :3], other[:, :3])
    return np.concatenate([low, np.maximum(one[:, 3:], other[:, 3:])], axis=1)


def _boxes(boxes: npt.NDArray[np.int32], counts: Ints) -> npt.NDArray[np.int32]:
    """Return the bounding box of each run of boxes, (p, 6)."""
    low = reduce_runs(np.minimum, boxes[:, :3], counts, nano.EMPTY_BOX[0])
    return np.concatenate([low, reduce_runs(np.maximum, boxes[:, 3:], counts, nano.EMPTY_BOX[3])], axis=1)


def add_stats(grid: VdbTree, leaf: Nodes, lower: Nodes, upper: Nodes, root: Nodes) -> None:
    """Write minimum, maximum, mean and standard deviation of the active values, from the leaves up to the root.

    A tile is weighted by its number of voxels.
    """
    active, values = grid.active_topology, grid.active_values[:, 0]
    tiles = iter(np.split(values[active.m :], np.cumsum(active.tile_counts)[:2]))
    spread = spread_of(values[: active.m], popcount(active.leaf_mask))
    _set_stats(leaf, spread)
    for nodes, name, edge in ((lower, "lower_mask", 8), (upper, "upper_mask", 128)):
        spread = spread_over(spread, popcount(getattr(active, name)))
        if active.tiles is not None:
            tile_spread = spread_of(next(tiles), popcount(getattr(active.tiles, name)), weight=edge**3)
            spread = spread_with(tile_spread, spread)
        _set_stats(nodes, spread)
    spread = spread_over(spread, np.array([len(upper)]))
    if active.tile_counts[2]:
        spread = spread_with(spread_of(next(tiles), np.array([active.tile_counts[2]]), weight=4096**3), spread)
    _set_stats(root, spread)
    if not active.count:
        root["stats"][:, :2] = grid.background


def _set_stats(nodes: Nodes, spread: RunSpread) -> None:
    nodes["stats"] = np.stack([spread.low, spread.high, spread.mean, spread.deviation], axis=1)


class LazyBytes(NamedTuple):
    """Bytes that are computed while they are written: the table of an index grid."""

    rows: Rows
    size: int


class GridBytes(NamedTuple):
    """The buffers of a grid, its GridData, and the box of its active voxels."""

    pieces: list[bytes | memoryview | LazyBytes]
    head: Any
    box: npt.NDArray[np.int32]


def size_of(piece: bytes | memoryview | LazyBytes) -> int:
    return piece.size if isinstance(piece, LazyBytes) else len(piece)


def write_grid(volume: Volume) -> GridBytes:
    """Write the single grid of a volume. Raises InvalidScene for a name that is too long, and for float16 colours."""
    grid = volume.grids[0]
    layout, topology = _layout_of(grid), grid.topology
    active = grid.active_topology if isinstance(grid, VdbTree) else topology
    blind = _blind(volume)
    starts = _starts(layout, topology, blind)
    root, entries = np.zeros(1, layout.root), np.zeros(_root_entries(topology), layout.tile)
    upper, lower = (_inner(layout.upper, topology.upper_mask), _inner(layout.lower, topology.lower_mask))
    leaf = _leaves(grid, active, layout)
    if active.tiles is not None:
        upper["tiles"], lower["tiles"] = active.tiles.upper_mask, active.tiles.lower_mask
    box = root["box"][0] = set_boxes(active, upper, lower)
    _link(upper, topology.upper_mask, starts.upper, _at(starts.lower, lower))
    _link(lower, topology.lower_mask, starts.lower, _at(starts.leaf, leaf))
    root["tiles"] = len(entries)
    if isinstance(grid, VdbTree):
        root["background"] = grid.background
        for nodes, masks in ((upper, topology.upper_mask), (lower, topology.lower_mask)):
            _fill(nodes, ~masks, _slots(grid.background[None], nodes))
        _put_tiles(grid, upper, lower)
    _put_entries(grid, entries, _at(starts.upper, upper) - starts.root)
    if layout is nano.FLOAT and isinstance(grid, VdbTree):
        with np.errstate(all="ignore"):  # non-finite values are kept, and so are their statistics
            add_stats(grid, leaf, lower, upper, root)
    head = _head(volume, layout, starts, box, bool(blind))
    tree = np.zeros(1, nano.TREE)
    tree["offsets"] = np.array([starts.leaf, starts.lower, starts.upper, starts.root]) - nano.GRID.itemsize
    tree["counts"], tree["voxels"] = topology.node_counts[::-1], active.voxel_count
    tree["tiles"] = active.tile_counts
    front = tree.tobytes() + root.tobytes() + entries.tobytes()
    head["crc"] = zlib.crc32(head.tobytes()[16:] + front), nano.HALF_CHECKSUM
    return GridBytes([head.tobytes() + front, *map(_view, (upper, lower, leaf)), *blind], head[0], box)


def _root_entries(topology: VdbTopology) -> int:
    """Return the number of the root's entries: upper nodes and tiles."""
    return len(topology.root_origin) + topology.tile_counts[2]


def _layout_of(grid: VdbTree | IndexGrid) -> nano.Layout:
    if isinstance(grid, IndexGrid):
        return nano.ON_INDEX
    if grid.values.shape[1] == 1:
        return nano.FLOAT if grid.values.dtype == np.float32 else nano.FP16
    if grid.values.dtype != np.float32:
        raise InvalidScene(Problem(f"grid {grid.name!r}", "is float16", "float32: NanoVDB has no half colours"))
    return nano.VEC3F


class _Starts(NamedTuple):
    """Offsets of the sections in the grid, and of its end."""

    root: int
    upper: int
    lower: int
    leaf: int
    blind: int
    end: int


def _starts(layout: nano.Layout, topology: VdbTopology, blind: list[bytes | memoryview | LazyBytes]) -> _Starts:
    root = nano.GRID.itemsize + nano.TREE.itemsize
    upper = root + layout.root.itemsize + _root_entries(topology) * layout.tile.itemsize
    lower = upper + len(topology.upper_mask) * layout.upper.itemsize
    leaf = lower + len(topology.lower_mask) * layout.lower.itemsize
    end = leaf + len(topology.leaf_mask) * layout.leaf.itemsize
    return _Starts(root, upper, lower, leaf, end, end + sum(map(size_of, blind)))


def _head(volume: Volume, layout: nano.Layout, starts: _Starts, box: npt.NDArray[np.int32], blind: bool) -> Nodes:
    grid = volume.grids[0]
    name = grid.name.encode()
    if len(name) >= nano.NAME_SIZE:
        found = f"is {len(name):,} bytes long"
        raise InvalidScene(Problem("the grid's name", found, f"{nano.NAME_SIZE - 1} at most in a .nvdb"))
    transform = volume.transform_of(grid)
    mat, vec = transform[:, :3], transform[:, 3]
    head = np.zeros(1, nano.GRID)
    head["magic"], head["version"], head["grids"], head["name"] = nano.MAGIC, layout.version_number, 1, name
    head["size"] = starts.end
    head["mat_f"], head["inv_f"], head["vec_f"], head["taper_f"] = mat, inverse(mat), vec, 1
    head["mat"], head["inv"], head["vec"], head["taper"] = mat, inverse(mat), vec, 1
    empty = bool(box[0] > box[3])
    stats = nano.FLAG_STATS if layout is nano.FLOAT else 0
    head["flags"] = (0 if empty else nano.FLAG_BOX) | stats | nano.FLAG_BREADTH_FIRST
    head["world"], head["voxel"] = _world_box(transform, box, empty), edges_of(transform)
    head["type"] = layout.number
    if isinstance(grid, IndexGrid):
        head["grid_class"], head["values"] = nano.INDEX_CLASS, grid.table_rows.shape[0]
    else:
        head["grid_class"] = nano.CLASSES[grid.grid_class or "unknown"]
    if blind:
        head["blind_offset"], head["blind"] = starts.blind, 2 if volume.frame else 1
    return head


def _world_box(transform: npt.NDArray[np.float64], box: npt.NDArray[np.int32], empty: bool) -> npt.NDArray[np.float64]:
    """Return the world bounding box of the index box, (6,). The end of the highest voxel is one further."""
    if empty:
        return np.repeat([np.finfo(np.float64).max, np.finfo(np.float64).min], 3)
    ends = np.stack([box[:3], box[3:] + 1])
    corners = np.stack([ends[np.arange(8) >> axis & 1, axis] for axis in range(3)], axis=1)
    world = transform_points(corners, transform)
    return np.concatenate([world.min(axis=0), world.max(axis=0)])


# -- nodes -----------------------------------------------------------------------------------------------------
def _inner(dtype: np.dtype[Any], masks: Words) -> Nodes:
    nodes = np.zeros(len(masks), dtype)
    nodes["children"], nodes["flags"] = masks, 2
    return nodes


def _at(start: int, nodes: Nodes) -> Ints:
    """Return the offset of each node in the grid."""
    return start + np.arange(len(nodes)) * nodes.dtype.itemsize


def _link(nodes: Nodes, masks: Words, start: int, children: Ints) -> None:
    """Write the offset from each node to its children, in the order of the mask bits."""
    row, slot = slots_of(masks)
    nodes["table"][row, slot, 0] = children - _at(start, nodes)[row]


def _fill(nodes: Nodes, masks: Words, values: npt.NDArray[np.int64]) -> None:
    """Write values (1 or all, slot words) into these slots of all nodes. Slots are zero before."""
    if values.any():
        row, slot = slots_of(masks)
        nodes["table"][row, slot] = values


def _slots(values: npt.NDArray[np.float32], nodes: Nodes) -> npt.NDArray[np.int64]:
    """Convert values (q, c) to the layout of table slots, (q, words)."""
    wide = np.zeros((len(values), 2 * nodes["table"].shape[2]), "<f4")
    wide[:, : values.shape[1]] = values
    return wide.view("<i8")


def _put_tiles(grid: VdbTree, upper: Nodes, lower: Nodes) -> None:
    """Write the values of the tiles in lower and upper nodes."""
    if (tiles := grid.topology.tiles) is not None:
        small, middle, _ = np.split(grid.values[grid.topology.m :], np.cumsum(tiles.counts)[:2])
        _fill(lower, tiles.lower_mask, _slots(small, lower))
        _fill(upper, tiles.upper_mask, _slots(middle, upper))


def _put_entries(grid: VdbTree | IndexGrid, entries: Nodes, children: Ints) -> None:
    """Write the root's entries sorted by key: nodes with the offsets of these children, and tiles."""
    topology = grid.topology
    nodes, keys = len(topology.root_origin), root_keys(topology.root_origin)
    place = np.arange(nodes)
    if topology.tiles is not None:
        keys = np.concatenate([keys, root_keys(topology.tiles.root_origin)])
        place = np.argsort(np.argsort(keys))
    entries["key"][place] = keys
    entries["child"][place[:nodes]] = children
    if isinstance(grid, VdbTree):
        first = topology.count - topology.tile_counts[2]
        entries["value"][place[:nodes]] = grid.background
        entries["value"][place[nodes:]] = grid.values[first:]
        entries["state"][place[nodes:]] = True if grid.active is None else grid.active[first:]


def _leaves(grid: VdbTree | IndexGrid, active: VdbTopology, layout: nano.Layout) -> Nodes:
    topology = grid.topology
    leaf = np.zeros(len(topology.leaf_mask), layout.leaf)
    low, high = active.leaf_boxes
    leaf["low"], leaf["dif"], leaf["mask"] = low, high - low, active.leaf_mask
    leaf["flags"] = np.where(active.leaf_mask.any(axis=1), 2, 0)
    if isinstance(grid, IndexGrid):
        # Seven cumulative bit counts of 9 bits each: of the mask words 0, 0 to 1, ..., 0 to 6.
        counts = prefix_counts(topology.leaf_mask)[:, 1:].astype(np.uint64) << np.arange(0, 63, 9, dtype=np.uint64)
        leaf["first"], leaf["prefix"] = 1 + topology.first, np.bitwise_or.reduce(counts, axis=1)
        return leaf
    row, slot = slots_of(topology.leaf_mask)
    if layout is nano.FP16:
        for problem in grid.value_problems():
            raise InvalidScene(problem)  # codes cannot represent non-finite values
        _quantise(grid, leaf, row * 512 + slot)
        return leaf
    if grid.background.any():
        leaf["values"] = grid.background
    leaf["values"][row, slot] = grid.values[: topology.m]
    return leaf


def _quantise(grid: VdbTree, leaf: Nodes, place: Ints) -> None:
    """Quantise to 16 bits between each leaf's minimum and maximum, background included: minimum + code * quantum."""
    dense = np.full((len(leaf), 512), grid.background[0], np.float32)
    dense.reshape(-1)[place] = grid.values[: grid.topology.m, 0]
    least = dense.min(axis=1)
    quantum = (dense.max(axis=1) - least) / np.float32(65535)
    leaf["least"], leaf["quantum"] = least, quantum
    scale = np.divide(1, quantum, out=np.zeros(len(leaf)), where=quantum > 0)
    leaf["values"] = np.rint((dense - least[:, None]) * scale[:, None])


# -- blind data ------------------------------------------------------------------------------------------------
def _blind(volume: Volume) -> list[bytes | memoryview | LazyBytes]:
    """Return the blind data: the table of an index grid, then the octree's frame."""
    grid = volume.grids[0]
    if not isinstance(grid, IndexGrid):
        return []
    rows = grid.table_rows
    count, itemsize = prod(rows.shape), rows.dtype.itemsize
    parts: list[tuple[str, int, int, int, int, bytes | LazyBytes]] = []
    number = nano.TABLE_TYPES[rows.dtype.name]
    parts.append(("M_vdb", count, itemsize, nano.CHANNEL_BLIND, number, LazyBytes(rows, count * itemsize)))
    if volume.frame is not None:
        text = frame_text(volume.frame).encode()
        parts.append((NAME, len(text), 1, 0, 0, text))
    structs = np.zeros(len(parts), nano.BLIND)
    sizes = [-(-size_of(data) // 32) * 32 for *_, data in parts]
    structs["offset"] = (np.arange(len(parts), 0, -1) * nano.BLIND.itemsize) + exclusive_sum(np.array(sizes))
    for struct, (name, count, size, blind_class, number, _) in zip(structs, parts, strict=True):
        struct["name"], struct["count"], struct["value_size"] = name.encode(), count, size
        struct["blind_class"], struct["type"] = blind_class, number
    pieces: list[bytes | memoryview | LazyBytes] = [structs.tobytes()]
    for size, (*_, data) in zip(sizes, parts, strict=True):
        pieces += [data, bytes(size - size_of(data))]
    return pieces


def _view(array: Nodes) -> memoryview:
    return np.ascontiguousarray(array).reshape(-1).view(np.uint8).data
