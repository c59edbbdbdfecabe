"""What NanoVDB's nodes say of what is active below them: boxes, and the least, greatest and mean value."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from nerfbake.formats.wire import nanovdb_nodes as nano
from nerfbake.kernels.arrays import Ints
from nerfbake.kernels.vdb.bitmask import popcount
from nerfbake.kernels.vdb.runs import RunSpread, reduce_runs, spread_of, spread_over, spread_with
from nerfbake.scene.vdb import VdbTree
from nerfbake.scene.vdb_tiles import Cubes
from nerfbake.scene.vdb_topology import VdbTopology

Nodes = npt.NDArray[Any]


def set_boxes(active: VdbTopology, upper: Nodes, lower: Nodes) -> npt.NDArray[np.int32]:
    """Puts boxes of active voxels and tiles into nodes; gives the whole tree's."""
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
    """(p, 6) around runs of boxes."""
    low = reduce_runs(np.minimum, boxes[:, :3], counts, nano.EMPTY_BOX[0])
    return np.concatenate([low, reduce_runs(np.maximum, boxes[:, 3:], counts, nano.EMPTY_BOX[3])], axis=1)


def add_stats(grid: VdbTree, leaf: Nodes, lower: Nodes, upper: Nodes, root: Nodes) -> None:
    """Least, greatest, mean and deviation of the active values, from the leaves up to the root; a tile counts as often
    as it has voxels."""
    active, values = grid.active_topology, grid.active_values[:, 0]
    tiles = iter(np.split(values[active.m :], np.cumsum(active.tile_counts)[:2]))
    spread = spread_of(values[: active.m], popcount(active.leaf_mask))
    _set_stats(leaf, spread)
    for nodes, name, edge in ((lower, "lower_mask", 8), (upper, "upper_mask", 128)):
        spread = spread_over(spread, popcount(getattr(active, name)))
        if active.tiles is not None:
            own = spread_of(next(tiles), popcount(getattr(active.tiles, name)), weight=edge**3)
            spread = spread_with(own, spread)
        _set_stats(nodes, spread)
    spread = spread_over(spread, np.array([len(upper)]))
    if active.tile_counts[2]:
        spread = spread_with(spread_of(next(tiles), np.array([active.tile_counts[2]]), weight=4096**3), spread)
    _set_stats(root, spread)
    if not active.count:
        root["stats"][:, :2] = grid.background


def _set_stats(nodes: Nodes, spread: RunSpread) -> None:
    nodes["stats"] = np.stack([spread.low, spread.high, spread.mean, spread.deviation], axis=1)
