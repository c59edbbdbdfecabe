"""Lattice field -> sparse voxel octree: values between the nodes become voxels, and colours a sigmoid's sums."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Literal

import numpy as np
import numpy.typing as npt

from nerfbake import memory, progress
from nerfbake.errors import InvalidScene, Problem
from nerfbake.kernels.arrays import Coords, Ints, Singles
from nerfbake.kernels.lattice.nodes import blended, densities, in_nodes
from nerfbake.scene.basis import parse_basis
from nerfbake.scene.lattice_field import LatticeField
from nerfbake.scene.octree import MAX_SIZE, Layout, SparseVoxelOctree
from nerfbake.scene.volume import OctreeFrame
from nerfbake.stages._block_voxels import Held, colour_blocks, held_of_blocks
from nerfbake.stages._cube_levels import Block, octree_of_blocks
from nerfbake.stages._half import rounded
from nerfbake.stages._lattice import fit_of, nodes_of, table_of
from nerfbake.stages.octree_to_octree import cut_octree

_TESTED = 1 << 18  # voxels whose density is asked at a time
_FITTED = 1 << 15  # voxels whose colours are made at a time
_FOUND = 0.3  # of the work is done when the voxels that hold something are found
_FOUND_BYTES = 16  # a voxel's place and density, while colours are not made yet


def octree_of_lattice(
    lattice: LatticeField,
    *,
    resolution: tuple[int, int, int] | None = None,
    basis: str = "SH9",
    layout: Layout = "full",
    dtype: Literal["float32", "float16"] = "float32",
    sigma_min: float | None = None,
) -> SparseVoxelOctree:
    """The lattice as W x H x D voxels over its box, as a breadth-first octree.

    resolution: (W, H, D), 1 to 4096; None: twice the lattice's cells. A voxel holds the density and the colour at its
    centre, interpolated as the lattice's own program does. Where it is as coarse as a cell of the lattice or coarser,
    it holds the mean of finer voxels, by build_octree's rule. Of a lattice of blocks, None is as many voxels as it has
    cells, or as many halvings of that as memory asks for, and voxels hold means of samples inside them; what the MLP of
    its colours is asked for is the mean, too.

    Colours become the sigmoid of sums of spherical harmonics, basis SH1 to SH25: by least squares of the logits over
    256 directions (measure_lattice() tells what that costs). Voxels whose density is 0, or below sigma_min (1/world
    unit), are empty; of means that is said of samples. Colours are made a part at a time, so that beside the octree
    little memory is needed.

    Raises InvalidScene for a broken lattice, for one that holds nothing, and for values that float16 cannot hold;
    MemoryLimit.

    >>> import numpy as np
    >>> from nerfbake import LatticeField, octree_of_lattice
    >>> from nerfbake.scene.lattice_field import Activation, RgbColour
    >>> links = np.arange(27, dtype=np.int32).reshape(3, 3, 3)
    >>> box, grey = np.array([[0.0] * 3, [1.0] * 3]), np.zeros((27, 3), np.float32)
    >>> lattice = LatticeField(links, np.ones(27, np.float32), grey, Activation(), RgbColour(), box)
    >>> octree_of_lattice(lattice, basis="SH1").size
    (6, 6, 6)
    """
    lattice.require_usable()
    wanted = parse_basis(basis)
    if wanted.kind != "SH":
        raise InvalidScene(Problem("basis", f"is {basis}", "SH1, SH4, SH9, SH16, SH25"))
    with progress.part(0, _FOUND):
        if lattice.blocks is not None:
            held, levels = held_of_blocks(lattice, resolution, wanted.size, sigma_min or 0.0), 0
        else:
            size, levels = _sizes(lattice, resolution)
            held = Held(size, *_held(lattice, size, sigma_min or 0.0))
    size, cells = held.size, held.cells
    if not len(cells):
        raise InvalidScene(Problem("the lattice", "holds nothing", f"a density above {sigma_min or 0:g} somewhere"))
    memory.require("the voxels' values", len(cells) * wanted.data_dim * 4)
    values = np.empty((len(cells), wanted.data_dim), np.float32)
    values[:, -1] = held.sigma
    with progress.part(_FOUND, 1):
        if lattice.blocks is not None:
            colour_blocks(lattice, held, wanted.size, sigma_min or 0.0, values)
        else:
            _colour(lattice, size, cells, wanted.size, values)
    data = rounded(values, np.dtype(dtype), what="the lattice", asked="float16")
    edges = (lattice.box[1] - lattice.box[0]) / size
    frame = OctreeFrame(size, basis, layout, lattice.box[0].copy(), edges)
    rows = np.arange(len(cells))
    octree = octree_of_blocks([Block(cells.astype(np.int64), 0, rows)], data, frame)
    if levels:
        octree = cut_octree(octree, level=octree.grid_level - levels)
    return memory.kept(octree)


def _sizes(lattice: LatticeField, resolution: tuple[int, int, int] | None) -> tuple[tuple[int, int, int], int]:
    """The voxels that are sampled along each axis, and how many levels finer these are than those that are wanted."""
    x, y, z = resolution or (min(2 * edge, MAX_SIZE) for edge in lattice.cells)
    if not all(1 <= edge <= MAX_SIZE for edge in (x, y, z)):
        raise InvalidScene(Problem("resolution", f"is {x}x{y}x{z}", f"1 to {MAX_SIZE} voxels an axis"))
    levels = 0
    while (
        any(edge << levels <= cells for edge, cells in zip((x, y, z), lattice.cells, strict=True))
        and max(x, y, z) << levels + 1 <= MAX_SIZE
    ):
        levels += 1
    return (x << levels, y << levels, z << levels), levels


def _held(lattice: LatticeField, size: tuple[int, int, int], sigma_min: float) -> tuple[Coords, Singles]:
    """(m, 3) the voxels that hold something, x-major, and (m,) their densities."""
    nodes, found, sigma, count = nodes_of(lattice), [], [], 0
    for cells in _near(lattice, size):
        density = densities(nodes, (cells + 0.5) / size)
        keep = (density > 0) & (density >= sigma_min)
        count += int(np.count_nonzero(keep))
        memory.require("the voxels' places", count * _FOUND_BYTES)
        found.append(cells[keep].astype(np.int32))
        sigma.append(density[keep])
    return np.concatenate(found), np.concatenate(sigma)


def _near(lattice: LatticeField, size: tuple[int, int, int]) -> Iterator[Ints]:
    """The voxels (k, 3), some at a time, that have a node with values among the eight around their centre."""
    low = [_node_below(lattice, size, axis) for axis in range(3)]
    planes = max(1, _TESTED // (size[1] * size[2]))
    rows = max(1, _TESTED // (planes * size[2]))  # of a plane: all of them, unless one alone has too many voxels
    for begin in progress.each(range(0, size[0], planes)):
        x = low[0][begin : begin + planes]
        for first in range(0, size[1], rows):
            y = low[1][first : first + rows]
            near = lattice.links[x[0] : x[-1] + 2, y[0] : y[-1] + 2] >= 0
            for axis, below in enumerate((x - x[0], y - y[0], low[2])):
                near = near.take(below, axis) | near.take(np.minimum(below + 1, near.shape[axis] - 1), axis)
            yield np.argwhere(near) + np.array([begin, first, 0])


def _node_below(lattice: LatticeField, size: tuple[int, int, int], axis: int) -> Ints:
    """(voxels,) the last node along an axis that is not beyond a voxel's centre."""
    centres = (np.arange(size[axis])[:, None] + 0.5) / size[axis]
    return in_nodes(np.repeat(centres, 3, 1), lattice.shape, lattice.at_corners)[:, axis].astype(np.int64)


def _colour(lattice: LatticeField, size: tuple[int, int, int], cells: Coords, B: int, values: Singles) -> None:
    """Writes the coefficients of all cells into the values (m, 3 B + 1)."""
    fit = fit_of(lattice, B)
    for begin in progress.each(range(0, len(cells), _FITTED)):
        at = in_nodes((cells[begin : begin + _FITTED] + 0.5) / size, lattice.shape, lattice.at_corners)
        # Only the nodes of some planes, whose links lead into a table of their own.
        first = int(at[0, 0])
        links, table = _planes(lattice, first, int(at[-1, 0]) + 2)
        at[:, 0] -= first
        values[begin : begin + len(at), :-1] = fit(blended(links, table, at))


def _planes(lattice: LatticeField, first: int, last: int) -> tuple[npt.NDArray[np.int32], Singles]:
    """The links and the features of the nodes from x = first to last."""
    links = lattice.links[first:last]
    held = links >= 0
    rows = links[held]
    memory.require("the lattice's planes", 4 * len(rows) * lattice.features.shape[1])
    own = np.full(links.shape, -1, np.int32)
    own[held] = np.arange(len(rows), dtype=np.int32)
    return own, table_of(lattice, rows)
