"""What a reader of VDB grids must find, worked out from the voxels one by one; and what ours finds."""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from math import floor, prod
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from nerfbake import load
from nerfbake.scene.vdb import IndexGrid, VdbTree
from nerfbake.scene.volume import OctreeFrame, Volume
from tests.conformance.case import Facts, floats

if TYPE_CHECKING:
    from tests.conformance.volumes import Grid, Scene


def facts_of(scene: Scene) -> Facts:
    return {"frame": _frame(scene.frame), "grids": [_grid_facts(grid, scene) for grid in scene.grids]}


def _grid_facts(grid: Grid, scene: Scene) -> Facts:
    order = sorted(grid.voxels, key=slots)
    transform = [list(map(float, row)) for row in grid.place or scene.transform]
    facts: Facts = {
        "name": grid.name,
        "class": grid.grid_class,
        "transform": transform,
        "background": _rounded(grid, grid.background),
        "voxels": [list(voxel) for voxel in order],
        "values": [_rounded(grid, grid.voxels[voxel]) for voxel in order],
    }
    if grid.grid_class == "index":
        facts["index"] = list(range(1, len(order) + 1))
    else:
        facts["active"] = [voxel not in grid.inactive for voxel in order]
        tiles = sorted(grid.tiles, key=lambda tile: (tile.edge, tile.low))
        facts["tiles"] = [
            {"low": list(tile.low), "edge": tile.edge, "value": list(tile.value), "active": tile.active}
            for tile in tiles
        ]
    facts["lookups"] = [
        _lookup(grid, transform, where, list(place)) for where, places in scene.places.items() for place in places
    ]
    return facts


def slots(voxel: tuple[int, ...]) -> tuple[int, ...]:
    """What voxels are sorted by: the root's tile, then the slots in the upper node, the lower node and the leaf."""
    found = [0, 0, 0, 0]
    for along in voxel:
        for level, (bits, shift) in enumerate(((21, 12), (5, 7), (4, 3), (3, 0))):
            own = along >> shift & (0xFFFFF if level == 0 else (1 << bits) - 1)
            found[level] = found[level] << bits | own
    return tuple(found)


def _rounded(grid: Grid, row: tuple[float, ...]) -> list[float]:
    """To the numbers that the file can hold."""
    return [float(grid.dtype(value)) for value in row]


def _lookup(grid: Grid, transform: list[list[float]], where: str, place: list[float]) -> Facts:
    low = [floor(p) for p in place]
    part = [p - start for p, start in zip(place, low, strict=True)]
    trilinear = [0.0] * len(grid.background)
    for corner in product((0, 1), repeat=3):
        weight = prod(far if c else 1 - far for far, c in zip(part, corner, strict=True))
        values = _value_at(grid, tuple(start + c for start, c in zip(low, corner, strict=True)))
        trilinear = [t + weight * v for t, v in zip(trilinear, values, strict=True)]
    return {
        "where": where,
        "point": [sum(a * p for a, p in zip(row, [*place, 1], strict=True)) for row in transform],
        "voxel": place,
        "nearest": _value_at(grid, tuple(floor(p + 0.5) for p in place)),
        "trilinear": trilinear,
    }


def _value_at(grid: Grid, voxel: tuple[int, ...]) -> list[float]:
    x, y, z = voxel
    if (x, y, z) in grid.voxels:
        return _rounded(grid, grid.voxels[x, y, z])
    for tile in grid.tiles:
        if all(start <= v < start + tile.edge for start, v in zip(tile.low, voxel, strict=True)):
            return list(tile.value)
    return _rounded(grid, grid.background)


# -- what our reader finds -------------------------------------------------------------------------------------
def answer(path: Path, expected: Facts) -> Facts:
    volume = load(path, Volume)
    grids = [
        _grid_answer(volume, grid, told["lookups"]) for grid, told in zip(volume.grids, expected["grids"], strict=True)
    ]
    return {"frame": _frame(volume.frame), "grids": grids}


def _grid_answer(volume: Volume, grid: VdbTree | IndexGrid, lookups: list[Facts]) -> Facts:
    topology, transform = grid.topology, volume.transform_of(grid)
    facts: Facts = {
        "name": grid.name,
        "class": "index" if isinstance(grid, IndexGrid) else grid.grid_class,
        "transform": floats(transform),
        "background": floats(grid.background),
        "voxels": floats(topology.coords),
        "values": floats(grid.values[: topology.m]),
    }
    if isinstance(grid, IndexGrid):
        facts["index"] = floats(1 + topology.rows_at(topology.coords))
    else:
        active = np.ones(topology.count, bool) if grid.active is None else grid.active
        lows = [(low, cubes.edge) for cubes in topology.tile_cubes for low in cubes.low.tolist()]
        facts["active"] = floats(active[: topology.m])
        facts["tiles"] = [
            {"low": low, "edge": edge, "value": value, "active": on}
            for (low, edge), value, on in zip(
                lows, grid.values[topology.m :].tolist(), active[topology.m :].tolist(), strict=True
            )
        ]
    places = replace(volume, transform=transform).index_of([each["point"] for each in lookups])
    facts["lookups"] = [
        {"where": told["where"], "point": told["point"], "voxel": place, "nearest": nearest, "trilinear": trilinear}
        for told, place, nearest, trilinear in zip(
            lookups,
            places.tolist(),
            grid.sample(places).tolist(),
            grid.sample(places, lookup="trilinear").tolist(),
            strict=True,
        )
    ]
    return facts


def _frame(frame: OctreeFrame | None) -> Any:
    if frame is None:
        return None
    return {
        "size": list(frame.size),
        "data_format": frame.data_format,
        "layout": frame.layout,
        "origin": floats(frame.origin),
        "voxel_size": floats(frame.voxel_size),
        "extra_data": floats(frame.extra_data),
    }
