"""Lattice of blocks -> voxels that hold means of samples, a part at a time: MERF's cells are too many to be made all.

A voxel's density is the mean of its samples', its diffuse colour and what the MLP is asked for the mean by their
opacity: what a ray through it adds up before MERF asks its MLP, which is then asked once for the voxel, too.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from nerfbake import memory, progress
from nerfbake.errors import InvalidScene, Problem
from nerfbake.kernels.arrays import Coords, Floats, Ints, Singles
from nerfbake.kernels.lattice.means import weighted_means
from nerfbake.kernels.lattice.nodes import Nodes, densities
from nerfbake.kernels.octree.means import mean_edge, opacity
from nerfbake.scene.lattice_field import DeferredColour, LatticeField
from nerfbake.scene.octree import MAX_SIZE
from nerfbake.stages._deferred import bare
from nerfbake.stages._lattice import features_of, fit_of_bare, nodes_of

_TOGETHER = 1 << 18  # samples that are looked at together
_SAMPLE_BYTES = 160  # a sample's place, its raw values, and these through the sigmoid
_FITTED = 1 << 15  # voxels whose colours are made at a time, at most
_FOUND_BYTES = 16  # a voxel's place and density
_COARSEST = 64  # voxels an axis, below which none are left out for want of memory

Size = tuple[int, int, int]


class Held(NamedTuple):
    """size (W, H, D) voxels; cells (m, 3) those that hold something, x-major, and sigma (m,) their densities."""

    size: Size
    cells: Coords
    sigma: Singles


class _Samples(NamedTuple):
    """Of a grid of this size, so many along each axis of a voxel."""

    nodes: Nodes
    size: Size
    times: int

    @property
    def in_voxel(self) -> int:
        """All of one."""
        return self.times**3

    @property
    def at_once(self) -> int:
        """Voxels whose samples are looked at together."""
        return max(1, _TOGETHER // self.in_voxel)

    def places(self, cells: Coords | Ints) -> Floats:
        """(k times^3, 3) those of cells (k, 3), cell by cell."""
        inside = np.stack(np.meshgrid(*[self.shares] * 3, indexing="ij"), -1).reshape(-1, 3)
        places: Floats = ((cells[:, None] + inside) / np.array(self.size)).reshape(-1, 3)
        return places

    @property
    def shares(self) -> Floats:
        """(times,) along an axis of a voxel."""
        return (np.arange(self.times) + 0.5) / self.times

    def blocks_along(self, axis: int) -> Ints:
        """(voxels, times) in which block along an axis each sample of a voxel is."""
        at = (np.arange(self.size[axis])[:, None] + self.shares) / self.size[axis]
        found = (at * self.nodes.block_times[axis] + self.nodes.block_plus[axis]).astype(np.int64)
        return np.asarray(np.clip(found, 0, self.nodes.links.shape[axis] - 1))


def held_of_blocks(lattice: LatticeField, size: Size | None, B: int, sigma_min: float) -> Held:
    """The voxels that hold something. size None: of one for each cell, of half as many along each axis, of a quarter,
    ..., the finest whose octree in B coefficients fits into memory. Raises InvalidScene for a size that cannot be."""
    if size is not None:
        if not all(1 <= edge <= MAX_SIZE for edge in size):
            W, H, D = size
            raise InvalidScene(Problem("resolution", f"is {W}x{H}x{D}", f"1 to {MAX_SIZE} voxels an axis"))
        return _held(_samples(lattice, size), sigma_min, None)
    W, H, D = (min(edge, MAX_SIZE) for edge in lattice.cells)
    while max(W, H, D) > _COARSEST:
        most = memory.left() // _voxel_bytes(B)
        found = _held(_samples(lattice, (W, H, D)), sigma_min, most)
        if len(found.cells) <= most:
            return found
        W, H, D = -(-W // 2), -(-H // 2), -(-D // 2)
    return _held(_samples(lattice, (W, H, D)), sigma_min, None)


def _voxel_bytes(B: int) -> int:
    """What a voxel takes at most on its way into an octree, and while that is compared with the lattice."""
    return 4 * (3 * B + 1) * 3 + 150


def _samples(lattice: LatticeField, size: Size) -> _Samples:
    """Twice as many samples as voxels along each axis, and as many as there are cells or more."""
    times = 2
    while any(times * edge < cells for edge, cells in zip(size, lattice.cells, strict=True)):
        times *= 2
    return _Samples(nodes_of(lattice), size, times)


def _held(samples: _Samples, sigma_min: float, most: int | None) -> Held:
    """Stops where it has found more than so many."""
    found, sigma, count = [], [], 0
    equal = np.ones(samples.at_once * samples.in_voxel)
    for cells in _near(samples):
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
        return Held(samples.size, np.zeros((0, 3), np.int32), np.zeros(0, np.float32))
    return Held(samples.size, np.concatenate(found), np.concatenate(sigma))


def _near(samples: _Samples) -> Iterator[Ints]:
    """The voxels (k, 3), some at a time, that have a sample in a block."""
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


def colour_blocks(lattice: LatticeField, held: Held, B: int, sigma_min: float, values: Singles) -> None:
    """Writes the coefficients of all cells into the values (m, 3 B + 1)."""
    colour = lattice.colour
    assert isinstance(colour, DeferredColour)
    samples = _samples(lattice, held.size)
    fit, looked = fit_of_bare(colour, B), features_of(lattice)
    length = mean_edge((lattice.box[1] - lattice.box[0]) / held.size) / samples.times
    step = min(samples.at_once, _FITTED)
    for begin in progress.each(range(0, len(held.cells), step)):
        memory.require("the voxels' samples", min(step, len(held.cells)) * samples.in_voxel * _SAMPLE_BYTES)
        places = samples.places(held.cells[begin : begin + step])
        sigma = densities(samples.nodes, places)
        sigma[sigma < sigma_min] = 0
        mean = weighted_means(bare(colour, looked(places)), opacity(sigma, length), samples.in_voxel)
        values[begin : begin + len(mean), :-1] = fit(mean)
