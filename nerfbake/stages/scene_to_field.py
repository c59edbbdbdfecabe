"""PlenOctree, octree, volume, field of bricks or page field -> the radiance field that ray marching reads.

A field of bricks becomes a grid of bricks, with cells of two and of one voxel below it, or with scenery an octree; its
values are not copied. VDB grids become nodes with a slot for each child, below a small octree of root tiles. The field
of a page contains the values that the page's shader reads, so that pages can be compared with the original field.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt

from nerfbake import memory
from nerfbake.errors import InvalidScene, Problem, UsageError
from nerfbake.kernels.arrays import Ints, Singles
from nerfbake.kernels.march.cells import EMPTY, Cells, cells_of
from nerfbake.kernels.maths.affine import inverse, rotate
from nerfbake.kernels.maths.elementary import log
from nerfbake.kernels.octree.brick_nodes import BLOCK_PATHS, brick_nodes, numbered
from nerfbake.kernels.octree.lookup import dilate
from nerfbake.kernels.parallel import over_chunks
from nerfbake.kernels.vdb.bitmask import exclusive_sum, slots_of
from nerfbake.scene.basis import Basis, parse_basis, renderable_basis
from nerfbake.scene.brick_field import BrickField
from nerfbake.scene.n3tree import N3Tree
from nerfbake.scene.octree import SparseVoxelOctree
from nerfbake.scene.page import ALL, CELL, WHOLE, WIDE, PageField
from nerfbake.scene.radiance_field import RadianceField, leaf_box, require_field
from nerfbake.scene.vdb import IndexGrid, VdbTree
from nerfbake.scene.vdb_topology import VdbTopology
from nerfbake.scene.volume import Volume
from nerfbake.stages._brick_tree import tree_of_bricks

_ROWS = 1 << 13  # of a tree's leaves that a core copies at a time


def build_field_from_n3tree(tree: N3Tree) -> RadianceField:
    """Build the field of a PlenOctree, with its nodes and its leaves with a density above 0.

    Raises InvalidScene for a tree that cannot be rendered.

    >>> from nerfbake import build_field_from_n3tree, sample_n3tree
    >>> print(build_field_from_n3tree(sample_n3tree(resolution=8)))
    SH9 field of 167 leaves over 8^3 cells
    """
    tree.require_usable()
    basis = renderable_basis(tree.data_format)
    data = tree.data.reshape(-1, tree.data_dim)
    held = np.flatnonzero(tree.leaf_mask.reshape(-1) & (data[:, -1] > 0))
    values = np.empty((len(held), tree.data_dim), np.float32)
    over_chunks(partial(_copy_rows, data, held, values), len(held), _ROWS)
    slots = np.full(tree.child.size, EMPTY, np.int32)
    slots[held] = -2 - np.arange(len(held), dtype=np.int32)
    for rows, children in zip(tree.levels[1:], tree.parent_cells[1:], strict=True):
        slots[children] = rows
    N, bits = tree.N, (tree.N - 1).bit_length()
    wide = 1 << bits
    if wide > N:
        own, slots = slots.reshape(tree.n, N, N, N), np.full(tree.n * wide**3, EMPTY, np.int32)
        slots.reshape(tree.n, wide, wide, wide)[:, :N, :N, :N] = own
    cells = cells_of(slots, [bits] * len(tree.levels), radix=N if wide > N else 0)
    place = cells.edge * np.column_stack([np.diag(tree.invradius), tree.offset])
    return memory.kept(RadianceField(cells, values, place, leaf_box(cells), basis))


def _copy_rows(data: npt.NDArray[Any], held: Ints, values: Singles, begin: int, end: int) -> None:
    values[begin:end] = data[held[begin:end]]


def build_field_from_octree(octree: SparseVoxelOctree) -> RadianceField:
    """Build the field of an octree, with its leaves with a density above 0. An octree without colours is grey.

    Raises InvalidScene for an octree that cannot be rendered.

    >>> from nerfbake import build_octree, build_field_from_octree, sample_n3tree
    >>> print(build_field_from_octree(build_octree(sample_n3tree(resolution=8))))
    SH9 field of 167 leaves over 8^3 cells
    """
    octree.require_usable()
    # A density without colours is grey, as in a volume.
    alone = octree.data_dim == 1 and not octree.data_format
    basis = parse_basis("RGBA") if alone else renderable_basis(octree.data_format)
    leaves = octree.childless & (octree.sigma > 0)
    number = np.full(octree.n, EMPTY, np.int32)
    number[leaves] = -2 - np.arange(int(leaves.sum()), dtype=np.int32)
    inner = np.flatnonzero(~octree.childless)
    number[inner] = np.arange(len(inner))
    # The octree's octants are x + 2y + 4z; the order of cells is [x][y][z].
    children = octree.node_children[inner].reshape(-1, 2, 2, 2).transpose(0, 3, 2, 1).reshape(-1, 8)
    slots = np.where(children == 0, np.int32(EMPTY), number[children])
    if not len(inner):
        slots = np.full((1, 8), number[0], np.int32)
    cells = cells_of(slots, [1] * max(octree.grid_level, 1))
    # Cells are voxels, except for an octree of a single voxel, where they are half as wide.
    scale = (cells.edge >> octree.grid_level) / octree.voxel_size
    place = np.column_stack([np.diag(scale), -octree.origin * scale])
    box = leaf_box(cells, np.array(octree.size) * (cells.edge >> octree.grid_level))
    values = octree.leaf_values(np.flatnonzero(leaves))
    if alone:
        values = np.concatenate([np.zeros((len(values), 3), np.float32), values], axis=1)
    return memory.kept(RadianceField(cells, values, place, box, basis))


STEPS = 255  # number of steps between 8-bit values


def build_field_from_page(page_field: PageField) -> RadianceField:
    """Build the field for render_field() with exactly the values of a page. Raises MemoryLimit.

    >>> from nerfbake import build_field, build_page_field, build_field_from_page, sample_n3tree
    >>> page_field = build_page_field(build_field(sample_n3tree(resolution=16)))
    >>> print(build_field_from_page(page_field))
    SH9 field of 573 leaves over 16^3 cells
    """
    rows = len(page_field.texels)
    memory.require("the page's field", rows * 4 * page_field.basis.data_dim + len(page_field.blocks) * 64 * (4 + 16))
    return memory.kept(
        RadianceField(_page_cells(page_field), page_field.values, page_field.place, page_field.box, page_field.basis)
    )


def round_to_bytes(field: RadianceField) -> RadianceField:
    """Return the field with its coefficients rounded to eight bits each, as a page with compressed data does.

    The k-th coefficients of red, green and blue become low + width q / 255 with an integer q. `low` is the minimum of
    each colour, and `width` the largest difference from it in any of the three. Densities are not changed.

    >>> from nerfbake import build_field, round_to_bytes, sample_n3tree
    >>> field = build_field(sample_n3tree(resolution=8))
    >>> rounded = round_to_bytes(field)
    >>> bool((rounded.values[:, -1] == field.values[:, -1]).all())
    True
    """
    require_field(field)
    B = field.basis.size
    values = field.values.copy()
    for k in range(B):
        own = field.values[:, k : 3 * B : B].astype(np.float64)
        low = own.min(axis=0, initial=np.inf) if len(own) else np.zeros(3)
        width = float((own - low).max(initial=0)) or 1.0
        steps = np.floor((own - low) / width * STEPS + 0.5)
        values[:, k : 3 * B : B] = low + width * (steps / STEPS)
    return memory.kept(replace(field, values=values))


def _page_cells(page_field: PageField) -> Cells:
    """Return an octree down to the top cells, with a table of 8^3 for each of its leaves."""
    top = page_field.top
    held = np.argwhere(top >= 0)
    number = top[tuple(held.T)].astype(np.int64)
    number = np.where(number >= WHOLE, -2 - (number - WHOLE), number)
    levels = _tile_levels(held, number, height=(max(top.shape) - 1).bit_length())
    tables = _tables(page_field)
    if not levels and len(number) and number[0] < EMPTY:
        tables[:] = number[0]  # the field is a single cell with one row
    bits = [1] * len(levels) + [CELL.bit_length() - 1]
    levels.append(tables)
    return _cells_of_levels(levels, bits)


def _cells_of_levels(levels: list[npt.NDArray[np.int32]], bits: list[int]) -> Cells:
    first = np.cumsum([0, *(level.size for level in levels[:-1])]).tolist()
    return cells_of(np.concatenate([level.reshape(-1) for level in levels]), bits, first=first)


def _tables(page_field: PageField) -> npt.NDArray[np.int32]:
    """Return the slots of each leaf (leaves, 512), x-major."""
    blocks = page_field.blocks
    masks = np.ascontiguousarray(blocks[:, :2]).astype("<u4").view(np.uint8)
    bits = np.unpackbits(masks, axis=1, bitorder="little")  # (8 leaves, 64)
    whole = blocks[:, 3] == ALL
    before = np.where(whole[:, None], 0, np.cumsum(bits, axis=1) - bits)
    slots = np.where(bits, -2 - (blocks[:, 2].astype(np.int64)[:, None] + before), EMPTY).astype(np.int32)
    # Axes: the block; the octant's x and the voxel's x in it; the same for y and z.
    octants = slots.reshape(-1, 2, 2, 2, 2, 2, 2)
    wide = blocks[:, 3, None] >> np.arange(WIDE, WIDE + 8, dtype=np.uint32) & 1 == 1
    slots = np.where(wide.reshape(-1, 2, 1, 2, 1, 2, 1), octants[:, :, :1, :, :1, :, :1], octants)
    # Axes: leaf; the block's x, y, z; the voxel's x, y, z in it.
    tables = slots.reshape(-1, 2, 2, 2, 4, 4, 4).transpose(0, 1, 4, 2, 5, 3, 6).reshape(-1, CELL**3)
    return np.ascontiguousarray(tables) if len(tables) else np.full((1, CELL**3), EMPTY, np.int32)


_CHUNK = 256  # bricks at a time: their cells stay in the second-level cache


def build_field_from_bricks(bricks: BrickField) -> RadianceField:
    """Build the field of bricks, with its cells with a density above 0; a wide cell stays one cell.

    Raises InvalidScene for a broken field.

    >>> import numpy as np
    >>> from nerfbake import BrickField, build_field_from_bricks
    >>> from nerfbake.scene.basis import Basis
    >>> rows = np.full((1, 512), -1, np.int32)
    >>> rows[0, 0] = 0
    >>> grey, box = np.array([[0, 0, 0, 50]], np.float32), np.array([[0.0] * 3, [1.0] * 3])
    >>> print(build_field_from_bricks(BrickField(8, box, Basis("SH", 1), np.zeros((1, 1, 1), np.int32), rows, grey)))
    SH1 field of 1 leaves over 8^3 cells
    """
    bricks.require_usable()
    cells = _brick_cells(bricks) if bricks.shells == 1 else _shell_cells(bricks)
    low, high = bricks.shell_box(bricks.shells - 1)
    scale = cells.edge / (high - low)
    # Scenery is where its PlenOctree is, to the last bit.
    start = -low * scale if bricks.shells == 1 else cells.edge * (-low / (high - low))
    place = np.column_stack([np.diag(scale), start])
    return memory.kept(RadianceField(cells, bricks.values, place, leaf_box(cells), bricks.basis))


def _brick_cells(bricks: BrickField) -> Cells:
    filled = bricks.values[:, -1] > 0
    split = np.empty(bricks.b, np.int64)

    def count(begin: int, end: int) -> None:
        split[begin:end] = np.count_nonzero(brick_nodes(bricks.rows[begin:end], filled).split, axis=(1, 2))

    over_chunks(count, bricks.b, _CHUNK)
    memory.require("the field's cells", 4 * (bricks.top.size + 64 * bricks.b + 8 * int(split.sum())))
    blocks = np.empty((bricks.b, 64), np.int32)
    smallest = np.empty((int(split.sum()), 8), np.int32)
    number = exclusive_sum(split)

    def fill(begin: int, end: int) -> None:
        found = brick_nodes(bricks.rows[begin:end], filled)
        below = numbered(found.split, number[begin:end])
        leaf = np.where(found.wide, -2 - found.row[..., 0], EMPTY)
        blocks[begin:end, BLOCK_PATHS] = np.where(found.split, below, leaf).reshape(-1, 64)
        cells = np.where(found.held, -2 - found.row, EMPTY)
        smallest[below[found.split]] = cells[found.split]

    over_chunks(fill, bricks.b, _CHUNK)
    levels = [np.maximum(bricks.top, EMPTY), blocks, smallest]
    return _cells_of_levels(levels, [(bricks.resolution // 8).bit_length() - 1, 2, 1])


def _shell_cells(bricks: BrickField) -> Cells:
    """Return the octree of a field with scenery, whose shells have cells of different sizes."""
    tree = tree_of_bricks(bricks, bricks.values[:, -1] > 0)
    memory.require("the field's cells", tree.nbytes + tree.child.nbytes)
    slots = np.where(tree.row >= 0, -2 - tree.row, np.int32(EMPTY))
    parents, octants = np.nonzero(tree.child)
    slots[parents, octants] = parents + tree.child[parents, octants]
    return cells_of(slots, [1] * (bricks.resolution.bit_length() - 1 + bricks.shells - 1))


_EDGE = 1e-6  # colours are clamped to this distance from 0 and 1, so that the sigmoid can be inverted


def build_field_from_volume(volume: Volume) -> RadianceField:
    """Build the field of a volume.

    The volume is an index grid with the coefficients of an octree, or a density with sh_0, sh_1, ..., with Cd (or
    color), or without colours. A tile becomes a cell of its size. A density without colours is grey, 0.5 of white, so
    that it is visible on a white background and on a black one. Raises InvalidScene for a volume without a density, for
    an index grid with unknown columns, and for broken grids.

    >>> from nerfbake import build_octree, build_vdb, build_field_from_volume, sample_n3tree
    >>> volume = build_vdb(build_octree(sample_n3tree(resolution=8)), grids=("density", "sh"))
    >>> str(build_field_from_volume(volume).basis)
    'SH9'
    """
    volume.require_usable()
    first = volume.grids[0]
    if isinstance(first, IndexGrid):
        topology, basis = first.topology, renderable_basis(volume.frame.data_format if volume.frame else "")
        values = first.values.astype(np.float32, copy=False)
        if values.shape[1] != 3 * basis.size + 1:
            found = f"has {values.shape[1]} columns"
            raise InvalidScene(Problem(f"table of {first.name!r}", found, f"{3 * basis.size + 1} for {basis}"))
        transform = volume.transform
    else:
        density = volume.density()
        topology, (colours, basis) = density.topology, _colours(volume, density)
        values = np.concatenate([colours, density.values.astype(np.float32, copy=False)], axis=1)
        transform = volume.transform_of(density)
    held = values[:, -1] > 0
    cells, low = _voxel_cells(topology, held)
    back = inverse(transform[:, :3])
    # A sample is at its voxel's centre, half a cell from the cell's corner.
    place = np.column_stack([back, 0.5 - low - rotate(transform[:, 3], back)])
    return memory.kept(RadianceField(cells, values[held], place, leaf_box(cells), basis))


def unused_grids(volume: Volume) -> list[str]:
    """Return the labels of the grids that build_field_from_volume() leaves out, and the places of unread ones."""
    first = volume.grids[0]
    used: list[VdbTree | IndexGrid] = [first]
    if not isinstance(first, IndexGrid):
        used = [volume.density(), *_colour_grids(volume)]
    labels = [label for label, grid in zip(volume.labels, volume.grids, strict=True) if grid not in used]
    return labels + [problem.place.removeprefix("grid ") for problem in volume.unread]


def _colour_grids(volume: Volume) -> list[VdbTree]:
    """Return the grids of the colours: sh_0, sh_1, ..., or Cd or color; the first of each name."""
    grids: dict[str, VdbTree] = {}
    for grid in volume.grids:
        if isinstance(grid, VdbTree) and grid.values.shape[1] == 3:
            grids.setdefault(grid.name, grid)
    count = next(k for k in range(len(grids) + 1) if f"sh_{k}" not in grids)
    return [grids[f"sh_{k}"] for k in range(count)] or [grids[name] for name in ("Cd", "color") if name in grids][:1]


def _colours(volume: Volume, density: VdbTree) -> tuple[npt.NDArray[np.float32], Basis]:
    """Return (count, 3 B) for the voxels and tiles of the density: all coefficients of red, of green, then of blue."""
    grids, topology = _colour_grids(volume), density.topology
    if not grids:
        return np.zeros((topology.count, 3), np.float32), parse_basis("RGBA")
    if grids[0].name == "sh_0":
        count = len(grids)
        basis = renderable_basis(volume.frame.data_format if volume.frame else f"SH{count}")
        if basis.size != count:
            raise InvalidScene(Problem("the volume", f"has {count} grids sh_k", f"{basis.size} for {basis}"))
        coefficients = [_values_at(volume, grid, density) for grid in grids]
        return np.stack(coefficients, axis=2).reshape(topology.count, -1), basis
    colour = np.clip(_values_at(volume, grids[0], density), _EDGE, 1 - _EDGE)
    return log(colour / (1 - colour)).astype(np.float32), parse_basis("RGBA")


def _values_at(volume: Volume, grid: VdbTree, density: VdbTree) -> npt.NDArray[np.float32]:
    """Return the values (count, 3) of another grid for the voxels and tiles of the density.

    Raises InvalidScene if the grids have different transforms, or if the other grid has several values in a tile.
    """
    if not np.array_equal(volume.transform_of(grid), volume.transform_of(density)):
        allowed = "one transform; `grid` for the density alone"
        raise InvalidScene(Problem(f"grid {grid.name!r}", "has another transform than the density", allowed))
    if grid.topology.same_as(density.topology):
        return grid.values.astype(np.float32, copy=False)
    parts, first = [grid.sample(density.topology.coords)], density.topology.m
    for level, (low, _) in zip((2, 1, 0), density.topology.tile_cubes, strict=False):
        # Where the other grid has a node, its values may differ from voxel to voxel.
        finer = (grid.topology.nodes_at(low)[level] >= 0) & (density.values[first : first + len(low), 0] > 0)
        if finer.any():
            place = ", ".join(map(str, low[int(np.argmax(finer))]))
            text = f"has voxels where the density has one tile, at ({place})"
            raise InvalidScene(Problem(f"grid {grid.name!r}", text, "tiles there, too; `grid` for the density alone"))
        parts.append(grid.sample(low))
        first += len(low)
    return np.concatenate(parts)


def _voxel_cells(topology: VdbTopology, held: npt.NDArray[np.bool_]) -> tuple[Cells, npt.NDArray[np.int64]]:
    """Return the tree, with row i for the i-th voxel or tile in `held`, and the voxel (3,) at its lowest corner."""
    need = sum(4 * max(nodes, 1) << 3 * width for nodes, width in zip(topology.node_counts, (5, 4, 3), strict=True))
    memory.require("the volume as cells", need)
    number = np.where(held, -1 - np.cumsum(held), EMPTY)  # -2 for the first
    of_voxels, *of_tiles = np.split(number, np.cumsum([topology.m, *topology.tile_counts])[:3])
    tiles = topology.tiles
    outer = topology.root_origin if tiles is None else np.concatenate([topology.root_origin, tiles.root_origin])
    places = outer.astype(np.int64) >> 12
    low = places.min(axis=0, initial=1 << 31)
    levels = _tile_levels(places - low, np.concatenate([np.arange(len(topology.root_origin)), of_tiles[2]]))
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
            table[:] = of_tiles[2][0]  # the root is one tile, so that there is no level of root tiles
        levels.append(table)
        bits.append(width)
    return _cells_of_levels(levels, bits), low * 4096


FieldSource = N3Tree | SparseVoxelOctree | Volume | BrickField
_STAGES: dict[type, Callable[[Any], RadianceField]] = {
    N3Tree: build_field_from_n3tree,
    SparseVoxelOctree: build_field_from_octree,
    Volume: build_field_from_volume,
    BrickField: build_field_from_bricks,
}


def build_field(scene: FieldSource) -> RadianceField:
    """Build the radiance field of a scene. Build it once, and use it for all pictures.

    Raises InvalidScene for a scene that cannot be rendered: broken scenes, SG and ASG bases, volumes without a density.
    Raises UsageError for a type of scene that has no field.

    >>> from nerfbake import build_field, build_octree, sample_n3tree
    >>> tree = sample_n3tree(resolution=8)
    >>> print(build_field(tree))
    SH9 field of 167 leaves over 8^3 cells
    >>> print(build_field(build_octree(tree)))
    SH9 field of 167 leaves over 8^3 cells
    """
    if type(scene) not in _STAGES:
        known = ", ".join(kind.__name__ for kind in _STAGES)
        raise UsageError(f"{type(scene).__name__} has no radiance field; allowed: {known}")
    return _STAGES[type(scene)](scene)


def _tile_levels(tiles: Ints, number: Ints, *, height: int | None = None) -> list[npt.NDArray[Any]]:
    """Return octree levels (nodes, 8) above tiles at (u, 3), coordinates from 0; the last level stores their numbers.

    height: number of levels; None: as few as possible, which is none for a single tile at the origin.
    """
    height = int(tiles.max(initial=0)).bit_length() if height is None else height
    x, y, z = (dilate(tiles[:, axis]) for axis in range(3))
    below = x << 2 | y << 1 | z
    levels: list[npt.NDArray[Any]] = []
    for _ in range(height):
        above, parent = np.unique(below >> 3, return_inverse=True)
        table = np.full((len(above), 8), EMPTY, np.int32)
        table[parent, below & 7] = number
        levels.insert(0, table)
        below, number = above, np.arange(len(above))
    return levels
