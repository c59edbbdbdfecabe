"""Lattice field -> sparse voxel octree: interpolated values become voxels, and colours become SH behind a sigmoid.

For a lattice of blocks, voxels store means of samples. They are computed in parts, because MERF has too many cells to
compute them all at once. The density of a voxel is the mean of its samples' densities. Its diffuse colour and the
inputs of the MLP are means weighted by the samples' opacities, like the sums along a ray in MERF. The MLP is then
evaluated once per voxel, as MERF evaluates it once per ray.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake import memory, progress
from nerfbake.errors import InvalidScene, Problem
from nerfbake.kernels.arrays import Coords, Floats, Ints, Singles
from nerfbake.kernels.lattice.blocks import weighted_means
from nerfbake.kernels.lattice.nodes import DensityNodes, densities, in_nodes, interpolate_rows
from nerfbake.kernels.octree.pyramid import mean_edge, opacity
from nerfbake.scene.basis import parse_basis
from nerfbake.scene.lattice_field import DeferredColour, LatticeField
from nerfbake.scene.octree import MAX_SIZE, Layout, SparseVoxelOctree
from nerfbake.scene.volume import OctreeFrame
from nerfbake.stages._cube_levels import Block, octree_of_blocks
from nerfbake.stages._deferred import diffuse_and_inputs
from nerfbake.stages._lattice import features_of, fit_of, fit_of_inputs, nodes_of, table_of
from nerfbake.stages.half import cast_values
from nerfbake.stages.octree_to_octree import cut_octree

_TOGETHER = 1 << 18  # samples that are evaluated at a time
_SAMPLE_BYTES = 160  # per sample: its position, its raw values, and their sigmoids
_FITTED = 1 << 15  # most voxels whose colours are computed at a time
_FOUND_BYTES = 16  # per voxel: its position and density
_COARSEST = 64  # voxels along an axis; the resolution is not reduced any further to save memory

Size = tuple[int, int, int]


class FilledVoxels(NamedTuple):
    """The voxels of a grid that are not empty.

    size   (W, H, D) voxels
    cells  (m, 3) the voxels that are not empty, x-major
    sigma  (m,) their densities
    """

    size: Size
    cells: Coords
    sigma: Singles


class _Samples(NamedTuple):
    """Sample positions in the voxels of a grid of this size, `times` along each axis of a voxel."""

    nodes: DensityNodes
    size: Size
    times: int

    @property
    def in_voxel(self) -> int:
        """Number of samples in a voxel."""
        return self.times**3

    @property
    def at_once(self) -> int:
        """Number of voxels whose samples are evaluated at a time."""
        return max(1, _TOGETHER // self.in_voxel)

    def places(self, cells: Coords | Ints) -> Floats:
        """Return the samples (k times^3, 3) of cells (k, 3), cell by cell."""
        inside = np.stack(np.meshgrid(*[self.shares] * 3, indexing="ij"), -1).reshape(-1, 3)
        places: Floats = ((cells[:, None] + inside) / np.array(self.size)).reshape(-1, 3)
        return places

    @property
    def shares(self) -> Floats:
        """Sample positions along an axis of a voxel, (times,) in 0..1."""
        return (np.arange(self.times) + 0.5) / self.times

    def blocks_along(self, axis: int) -> Ints:
        """Return the index of the block that contains each sample along an axis, (voxels, times)."""
        at = (np.arange(self.size[axis])[:, None] + self.shares) / self.size[axis]
        found = (at * self.nodes.block_times[axis] + self.nodes.block_plus[axis]).astype(np.int64)
        return np.asarray(np.clip(found, 0, self.nodes.links.shape[axis] - 1))


def filled_voxels(lattice: LatticeField, size: Size | None, B: int, sigma_min: float) -> FilledVoxels:
    """Return the voxels of a lattice of blocks that are not empty.

    size None: one voxel per cell, halved along each axis until the octree with B coefficients fits into memory. Raises
    InvalidScene for a size out of range.
    """
    if size is not None:
        if not all(1 <= edge <= MAX_SIZE for edge in size):
            W, H, D = size
            raise InvalidScene(Problem("resolution", f"is {W}x{H}x{D}", f"1 to {MAX_SIZE} voxels an axis"))
        return _block_voxels(_samples(lattice, size), sigma_min, None)
    W, H, D = (min(edge, MAX_SIZE) for edge in lattice.cells)
    while max(W, H, D) > _COARSEST:
        most = memory.left() // _voxel_bytes(B)
        found = _block_voxels(_samples(lattice, (W, H, D)), sigma_min, most)
        if len(found.cells) <= most:
            return found
        W, H, D = -(-W // 2), -(-H // 2), -(-D // 2)
    return _block_voxels(_samples(lattice, (W, H, D)), sigma_min, None)


def _voxel_bytes(B: int) -> int:
    """Return the most bytes per voxel while the octree is built, and while it is compared with the lattice."""
    return 4 * (3 * B + 1) * 3 + 150


def _samples(lattice: LatticeField, size: Size) -> _Samples:
    """Return samples: at least two per voxel along each axis, and at least as many as there are cells."""
    times = 2
    while any(times * edge < cells for edge, cells in zip(size, lattice.cells, strict=True)):
        times *= 2
    return _Samples(nodes_of(lattice), size, times)


def _block_voxels(samples: _Samples, sigma_min: float, most: int | None) -> FilledVoxels:
    """Return the voxels that are not empty. Stops early if there are more than `most`."""
    found, sigma, count = [], [], 0
    equal = np.ones(samples.at_once * samples.in_voxel)
    for cells in _near_blocks(samples):
        for begin in range(0, len(cells), samples.at_once):
            some = cells[begin : begin + samples.at_once]
            own = densities(samples.nodes, samples.places(some))
            own[own < sigma_min] = 0
            mean = weighted_means(own[:, None], equal[: len(own)], samples.in_voxel)[:, 0]
            keep = mean > 0
            count += int(np.count_nonzero(keep))
            memory.require("the voxels' places", count * _FOUND_BYTES)
            found.append(some[keep].astype(np.int32))
            sigma.append(mean[keep])
        if most is not None and count > most:
            break
    if not found:
        return FilledVoxels(samples.size, np.zeros((0, 3), np.int32), np.zeros(0, np.float32))
    return FilledVoxels(samples.size, np.concatenate(found), np.concatenate(sigma))


def _near_blocks(samples: _Samples) -> Iterator[Ints]:
    """Yield the voxels (k, 3) that have a sample in a block, in parts."""
    held = samples.nodes.links >= 0
    blocks = [samples.blocks_along(axis) for axis in range(3)]
    planes = max(1, _TOGETHER // (samples.size[1] * samples.size[2]))
    for begin in progress.each(range(0, samples.size[0], planes)):
        near = held
        for axis, each in enumerate((blocks[0][begin : begin + planes], *blocks[1:])):
            found = near.take(each[:, 0], axis)
            for sample in range(1, samples.times):
                found |= near.take(each[:, sample], axis)
            near = found
            if not near.any():
                break
        else:
            yield np.argwhere(near) + np.array([begin, 0, 0])


def colour_blocks(lattice: LatticeField, held: FilledVoxels, B: int, sigma_min: float, values: Singles) -> None:
    """Write the SH coefficients of all voxels of a lattice of blocks into values (m, 3 B + 1)."""
    colour = lattice.colour
    assert isinstance(colour, DeferredColour)
    samples = _samples(lattice, held.size)
    fit, looked = fit_of_inputs(colour, B), features_of(lattice)
    length = mean_edge((lattice.box[1] - lattice.box[0]) / held.size) / samples.times
    step = min(samples.at_once, _FITTED)
    for begin in progress.each(range(0, len(held.cells), step)):
        memory.require("the voxels' samples", min(step, len(held.cells)) * samples.in_voxel * _SAMPLE_BYTES)
        places = samples.places(held.cells[begin : begin + step])
        sigma = densities(samples.nodes, places)
        sigma[sigma < sigma_min] = 0
        mean = weighted_means(diffuse_and_inputs(colour, looked(places)), opacity(sigma, length), samples.in_voxel)
        values[begin : begin + len(mean), :-1] = fit(mean)


_TESTED = 1 << 18  # voxels whose density is evaluated at a time
_FOUND = 0.3  # progress when the non-empty voxels have been found


def build_octree_from_lattice(
    lattice: LatticeField,
    *,
    resolution: tuple[int, int, int] | None = None,
    basis: str = "SH9",
    layout: Layout = "full",
    dtype: Literal["float32", "float16"] = "float32",
    sigma_min: float | None = None,
) -> SparseVoxelOctree:
    """Resample a lattice to W x H x D voxels over its box, as a breadth-first octree.

    resolution: (W, H, D), 1 to 4096; None: twice the lattice's cells. A voxel stores the density and the colour at its
    centre, interpolated as in the lattice's original program. If a voxel is as large as a cell of the lattice or
    larger, it stores the mean of finer voxels by the rule of build_octree(). For a lattice of blocks, None is one
    voxel per cell, halved along each axis until the octree fits into memory. Its voxels store means of samples inside
    them, and the MLP of its colours is evaluated for these means.

    Colours become the sigmoid of a sum of spherical harmonics, basis SH1 to SH25, by a least-squares fit of the logits
    in 256 directions; measure_lattice() returns the error of the fit. Voxels with a density of 0, or below sigma_min
    (1/world unit), are empty; in a lattice of blocks these limits apply to samples. Colours are computed in parts,
    which needs little memory in addition to the octree.

    Raises InvalidScene for a broken lattice, for one without visible voxels, and for values that are too large for
    float16; MemoryLimit.

    >>> import numpy as np
    >>> from nerfbake import LatticeField, build_octree_from_lattice
    >>> from nerfbake.scene.lattice_field import Activation, RgbColour
    >>> links = np.arange(27, dtype=np.int32).reshape(3, 3, 3)
    >>> box, grey = np.array([[0.0] * 3, [1.0] * 3]), np.zeros((27, 3), np.float32)
    >>> lattice = LatticeField(links, np.ones(27, np.float32), grey, Activation(), RgbColour(), box)
    >>> build_octree_from_lattice(lattice, basis="SH1").size
    (6, 6, 6)
    """
    lattice.require_usable()
    wanted, least = parse_basis(basis), sigma_min or 0.0
    if wanted.kind != "SH":
        raise InvalidScene(Problem("basis", f"is {basis}", "SH1, SH4, SH9, SH16, SH25"))
    with progress.part(0, _FOUND):
        if lattice.blocks is not None:
            held, levels = filled_voxels(lattice, resolution, wanted.size, least), 0
        else:
            size, levels = _sizes(lattice, resolution)
            held = FilledVoxels(size, *_held(lattice, size, least))
    size, cells = held.size, held.cells
    if not len(cells):
        raise InvalidScene(Problem("the lattice", "is empty", f"a density above {least:g} somewhere"))
    memory.require("the voxels' values", len(cells) * wanted.data_dim * 4)
    values = np.empty((len(cells), wanted.data_dim), np.float32)
    values[:, -1] = held.sigma
    with progress.part(_FOUND, 1):
        if lattice.blocks is not None:
            colour_blocks(lattice, held, wanted.size, least, values)
        else:
            _colour(lattice, size, cells, wanted.size, values)
    data = cast_values(values, np.dtype(dtype), what="the lattice", asked="float16")
    edges = (lattice.box[1] - lattice.box[0]) / size
    frame = OctreeFrame(size, basis, layout, lattice.box[0].copy(), edges)
    rows = np.arange(len(cells))
    octree = octree_of_blocks([Block(cells.astype(np.int64), 0, rows)], data, frame)
    if levels:
        octree = cut_octree(octree, level=octree.grid_level - levels)
    return memory.kept(octree)


def _sizes(lattice: LatticeField, resolution: tuple[int, int, int] | None) -> tuple[tuple[int, int, int], int]:
    """Return the number of voxels to sample along each axis, and how many levels finer they are than requested."""
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
    """Return the voxels that are not empty (m, 3), x-major, and their densities (m,)."""
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
    """Yield the voxels (k, 3), in parts, that have a stored node among the eight around their centre."""
    low = [_node_below(lattice, size, axis) for axis in range(3)]
    planes = max(1, _TESTED // (size[1] * size[2]))
    rows = max(1, _TESTED // (planes * size[2]))  # all rows of a plane, unless a single plane has too many voxels
    for begin in progress.each(range(0, size[0], planes)):
        x = low[0][begin : begin + planes]
        for first in range(0, size[1], rows):
            y = low[1][first : first + rows]
            near = lattice.links[x[0] : x[-1] + 2, y[0] : y[-1] + 2] >= 0
            for axis, below in enumerate((x - x[0], y - y[0], low[2])):
                near = near.take(below, axis) | near.take(np.minimum(below + 1, near.shape[axis] - 1), axis)
            yield np.argwhere(near) + np.array([begin, first, 0])


def _node_below(lattice: LatticeField, size: tuple[int, int, int], axis: int) -> Ints:
    """Return for each voxel along an axis (voxels,) the last node at or before its centre."""
    centres = (np.arange(size[axis])[:, None] + 0.5) / size[axis]
    return in_nodes(np.repeat(centres, 3, 1), lattice.shape, lattice.at_corners)[:, axis].astype(np.int64)


def _colour(lattice: LatticeField, size: tuple[int, int, int], cells: Coords, B: int, values: Singles) -> None:
    """Write the SH coefficients of all cells into values (m, 3 B + 1)."""
    fit = fit_of(lattice, B)
    for begin in progress.each(range(0, len(cells), _FITTED)):
        at = in_nodes((cells[begin : begin + _FITTED] + 0.5) / size, lattice.shape, lattice.at_corners)
        # Gather only the nodes of the planes needed for this part, with links into a smaller table.
        first = int(at[0, 0])
        links, table = _planes(lattice, first, int(at[-1, 0]) + 2)
        at[:, 0] -= first
        values[begin : begin + len(at), :-1] = fit(interpolate_rows(links, table, at))


def _planes(lattice: LatticeField, first: int, last: int) -> tuple[npt.NDArray[np.int32], Singles]:
    """Return the links and the features of the nodes with first <= x < last."""
    links = lattice.links[first:last]
    held = links >= 0
    rows = links[held]
    memory.require("the lattice's planes", 4 * len(rows) * lattice.features.shape[1])
    own = np.full(links.shape, -1, np.int32)
    own[held] = np.arange(len(rows), dtype=np.int32)
    return own, table_of(lattice, rows)
