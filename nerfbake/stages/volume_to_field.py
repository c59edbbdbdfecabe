"""VDB grids -> the field that a marcher reads: nodes with a slot for each place, below a small octree of root tiles."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from nerfbake import memory
from nerfbake.errors import InvalidScene, Problem
from nerfbake.kernels.march.cells import EMPTY, Cells, cells_of
from nerfbake.kernels.maths.affine import inverse, turned
from nerfbake.kernels.maths.elementary import log
from nerfbake.kernels.vdb.bitmask import slots_of
from nerfbake.scene.basis import Basis, parse_basis, shown_basis
from nerfbake.scene.radiance_field import RadianceField, leaf_box
from nerfbake.scene.vdb import IndexGrid, VdbTree
from nerfbake.scene.vdb_topology import VdbTopology
from nerfbake.scene.volume import Volume
from nerfbake.stages._fog import density_of
from nerfbake.stages._tile_levels import tile_levels

_EDGE = 1e-6  # how near to 0 and 1 a colour may be, for its sigmoid to be undone


def field_of_volume(volume: Volume) -> RadianceField:
    """An index grid with the coefficients of an octree; or density, with sh_0, sh_1, ..., with Cd (or color), or grey.

    Tiles are cells as large as they are. A density without colours is grey, 0.5 of white: what it hides shows on a
    white background as well as on a black one. Raises InvalidScene where there is no density, or an index of unknown
    columns, and for broken grids.

    >>> from nerfbake import build_octree, build_vdb, field_of_volume, sample_n3tree
    >>> volume = build_vdb(build_octree(sample_n3tree(resolution=8)), grids=("density", "sh"))
    >>> str(field_of_volume(volume).basis)
    'SH9'
    """
    volume.require_usable()
    first = volume.grids[0]
    if isinstance(first, IndexGrid):
        topology, basis = first.topology, shown_basis(volume.frame.data_format if volume.frame else "")
        values = first.values.astype(np.float32, copy=False)
        if values.shape[1] != 3 * basis.size + 1:
            found = f"has {values.shape[1]} columns"
            raise InvalidScene(Problem(f"table of {first.name!r}", found, f"{3 * basis.size + 1} for {basis}"))
        transform = volume.transform
    else:
        density = density_of(volume)
        topology, (colours, basis) = density.topology, _colours(volume, density)
        values = np.concatenate([colours, density.values.astype(np.float32, copy=False)], axis=1)
        transform = volume.transform_of(density)
    held = values[:, -1] > 0
    cells, low = _cells(topology, held)
    back = inverse(transform[:, :3])
    # A sample stands at its voxel's centre, half a cell from the cell's corner.
    place = np.column_stack([back, 0.5 - low - turned(transform[:, 3], back)])
    return memory.kept(RadianceField(cells, values[held], place, leaf_box(cells), basis))


def _colours(volume: Volume, density: VdbTree) -> tuple[npt.NDArray[np.float32], Basis]:
    """(count, 3 B): all coefficients of red, then of green, then of blue, for each voxel and tile of the density."""
    grids = {grid.name: grid for grid in volume.grids if isinstance(grid, VdbTree) and grid.values.shape[1] == 3}
    count = next(k for k in range(len(grids) + 1) if f"sh_{k}" not in grids)
    topology = density.topology
    if count:
        basis = shown_basis(volume.frame.data_format if volume.frame else f"SH{count}")
        if basis.size != count:
            raise InvalidScene(Problem("the volume", f"has {count} grids sh_k", f"{basis.size} for {basis}"))
        coefficients = [_values_at(volume, grids[f"sh_{k}"], density) for k in range(count)]
        return np.stack(coefficients, axis=2).reshape(topology.count, -1), basis
    named = [grids[name] for name in ("Cd", "color") if name in grids]
    if not named:
        return np.zeros((topology.count, 3), np.float32), parse_basis("RGBA")
    colour = np.clip(_values_at(volume, named[0], density), _EDGE, 1 - _EDGE)
    return log(colour / (1 - colour)).astype(np.float32), parse_basis("RGBA")


def _values_at(volume: Volume, grid: VdbTree, density: VdbTree) -> npt.NDArray[np.float32]:
    """(count, 3) of another grid where the density has values. Raises InvalidScene where it has more than one."""
    if not np.array_equal(volume.transform_of(grid), volume.transform_of(density)):
        allowed = "one transform; `grid` for the density alone"
        raise InvalidScene(Problem(f"grid {grid.name!r}", "stands elsewhere than the density", allowed))
    if grid.topology.same_as(density.topology):
        return grid.values.astype(np.float32, copy=False)
    parts, first = [grid.sample(density.topology.coords)], density.topology.m
    for level, (low, _) in reversed(list(enumerate(density.topology.tile_cubes[::-1]))):
        # Below a node the other grid's values may differ from voxel to voxel.
        finer = (grid.topology.nodes_at(low)[level] >= 0) & (density.values[first : first + len(low), 0] > 0)
        if finer.any():
            place = ", ".join(map(str, low[int(np.argmax(finer))]))
            text = f"has voxels where the density has one tile, at ({place})"
            raise InvalidScene(Problem(f"grid {grid.name!r}", text, "tiles there, too; `grid` for the density alone"))
        parts.append(grid.sample(low))
        first += len(low)
    return np.concatenate(parts)


def _cells(topology: VdbTopology, held: npt.NDArray[np.bool_]) -> tuple[Cells, npt.NDArray[np.int64]]:
    """The tree, with row i for the i-th held voxel or tile, and the voxel (3,) at its lowest corner."""
    need = sum(4 * max(nodes, 1) << 3 * width for nodes, width in zip(topology.node_counts, (5, 4, 3), strict=True))
    memory.require("the volume as cells", need)
    number = np.where(held, -1 - np.cumsum(held), EMPTY)  # -2 for the first
    of_voxels, *of_tiles = np.split(number, np.cumsum([topology.m, *topology.tile_counts])[:3])
    tiles = topology.tiles
    outer = topology.root_origin if tiles is None else np.concatenate([topology.root_origin, tiles.root_origin])
    places = outer.astype(np.int64) >> 12
    low = places.min(axis=0, initial=1 << 31)
    levels = tile_levels(places - low, np.concatenate([np.arange(len(topology.root_origin)), of_tiles[2]]))
    bits = [1] * len(levels)
    masks = topology.upper_mask, topology.lower_mask, topology.leaf_mask
    of_nodes = tiles and [(tiles.upper_mask, of_tiles[1]), (tiles.lower_mask, of_tiles[0])]
    for level, (mask, width) in enumerate(zip(masks, (5, 4, 3), strict=True)):
        table = np.full((max(len(mask), 1), 1 << 3 * width), EMPTY, np.int32)
        node, slot = slots_of(mask)
        table[node, slot] = of_voxels if width == 3 else np.arange(len(node))
        if of_nodes and width > 3:
            table[slots_of(of_nodes[level][0])] = of_nodes[level][1]
        if not level and not len(mask) and len(of_tiles[2]) == 1:
            table[:] = of_tiles[2][0]  # the root is one tile: no level of root tiles says so
        levels.append(table)
        bits.append(width)
    first = np.cumsum([0, *(level.size for level in levels[:-1])]).tolist()
    cells = cells_of(np.concatenate([level.reshape(-1) for level in levels]), bits, first=first)
    return cells, low * 4096
