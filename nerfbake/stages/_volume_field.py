"""VDB grids as a field of cells: nodes with a slot for each place, below a small octree of root tiles."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from nerfbake.errors import InvalidScene, Problem, format_size
from nerfbake.kernels.bitmask import slots_of
from nerfbake.kernels.cells import EMPTY, Cells, cells_of
from nerfbake.kernels.morton import dilate
from nerfbake.scene.basis import Basis, parse_basis
from nerfbake.scene.vdb import IndexGrid, VdbTree
from nerfbake.scene.vdb_topology import VdbTopology
from nerfbake.scene.volume import Volume
from nerfbake.stages._field import Field, box_of, shown_basis

MAX_CELLS = 4 << 30  # bytes: sixteen times what masks take, and files may declare many of those
_EDGE = 1e-6  # how near to 0 and 1 a colour may be, for its sigmoid to be undone
Ints = npt.NDArray[np.int64]


def field_of_volume(volume: Volume) -> Field:
    """An index grid with the coefficients of an octree; or density, with sh_0, sh_1, ..., with Cd (or color), or grey.

    Raises InvalidScene where there is no density, or an index of unknown columns.
    """
    first = volume.grids[0]
    if isinstance(first, IndexGrid):
        topology, basis = first.topology, shown_basis(volume.frame.data_format if volume.frame else "")
        values = first.values.astype(np.float32, copy=False)
        if values.shape[1] != 3 * basis.size + 1:
            found = f"has {values.shape[1]} columns"
            raise InvalidScene(Problem(f"table of {first.name!r}", found, f"{3 * basis.size + 1} for {basis}"))
    else:
        density = _density(volume)
        topology, (colours, basis) = density.topology, _colours(volume, density.topology)
        values = np.concatenate([colours, density.values.astype(np.float32, copy=False)], axis=1)
    held = values[:, -1] > 0
    cells, low = _cells(topology, held)
    inverse = np.linalg.inv(volume.transform[:, :3])
    # A sample stands at its voxel's centre, half a cell from the cell's corner.
    place = np.column_stack([inverse, 0.5 - low - inverse @ volume.transform[:, 3]])
    return Field(cells, values[held], place, box_of(cells), basis)


def _density(volume: Volume) -> VdbTree:
    for grid in volume.grids:
        if isinstance(grid, VdbTree) and grid.name == "density" and grid.values.shape[1] == 1:
            return grid
    names = ", ".join(grid.name for grid in volume.grids)
    raise InvalidScene(Problem("the volume", f"has the grids {names}", "density among them, or index"))


def _colours(volume: Volume, topology: VdbTopology) -> tuple[npt.NDArray[np.float32], Basis]:
    """(m, 3 B): all coefficients of red, then of green, then of blue, for each of these voxels."""
    grids = {grid.name: grid for grid in volume.grids if isinstance(grid, VdbTree) and grid.values.shape[1] == 3}
    count = next(k for k in range(len(grids) + 1) if f"sh_{k}" not in grids)
    if count:
        basis = shown_basis(volume.frame.data_format if volume.frame else f"SH{count}")
        if basis.size != count:
            raise InvalidScene(Problem("the volume", f"has {count} grids sh_k", f"{basis.size} for {basis}"))
        coefficients = [_values_at(grids[f"sh_{k}"], topology) for k in range(count)]
        return np.stack(coefficients, axis=2).reshape(topology.m, -1), basis
    named = [grids[name] for name in ("Cd", "color") if name in grids]
    if not named:
        return np.zeros((topology.m, 3), np.float32), parse_basis("RGBA")
    colour = np.clip(_values_at(named[0], topology), _EDGE, 1 - _EDGE)
    return np.log(colour / (1 - colour)), parse_basis("RGBA")


def _values_at(grid: VdbTree, topology: VdbTopology) -> npt.NDArray[np.float32]:
    return (
        grid.values.astype(np.float32, copy=False) if grid.topology.same_as(topology) else grid.sample(topology.coords)
    )


def _cells(topology: VdbTopology, held: npt.NDArray[np.bool_]) -> tuple[Cells, npt.NDArray[np.int64]]:
    """The tree, with row i for the i-th held voxel, and the voxel (3,) at its lowest corner."""
    need = sum(4 * nodes << 3 * width for nodes, width in zip(topology.node_counts, (5, 4, 3), strict=True))
    if need > MAX_CELLS:
        raise InvalidScene(Problem("the volume", f"needs {format_size(need)} as cells", format_size(MAX_CELLS)))
    tiles = topology.root_origin.astype(np.int64) >> 12
    low = tiles.min(axis=0, initial=1 << 31)
    levels = _tile_levels(tiles - low)
    bits = [1] * len(levels)
    for masks, width in ((topology.upper_mask, 5), (topology.lower_mask, 4), (topology.leaf_mask, 3)):
        node, slot = slots_of(masks)
        below = np.arange(len(node))
        if width == 3:
            below = np.where(held, -1 - np.cumsum(held), EMPTY)  # -2 for the first
        table = np.full((max(len(masks), 1), 1 << 3 * width), EMPTY, np.int32)
        table[node, slot] = below
        levels.append(table)
        bits.append(width)
    first = np.cumsum([0, *(level.size for level in levels[:-1])]).tolist()
    cells = cells_of(np.concatenate([level.reshape(-1) for level in levels]), bits, first=first)
    return cells, low * 4096


def _tile_levels(tiles: Ints) -> list[npt.NDArray[Any]]:
    """Octree levels (nodes, 8) down to root tiles (u, 3) from 0 on; none where there is one tile."""
    height = int(tiles.max(initial=0)).bit_length()
    x, y, z = (dilate(tiles[:, axis]) for axis in range(3))
    below, number = x << 2 | y << 1 | z, np.arange(len(tiles), dtype=np.int32)
    levels: list[npt.NDArray[Any]] = []
    for _ in range(height):
        above, parent = np.unique(below >> 3, return_inverse=True)
        table = np.full((len(above), 8), EMPTY, np.int32)
        table[parent, below & 7] = number
        levels.insert(0, table)
        below, number = above, np.arange(len(above), dtype=np.int32)
    return levels
