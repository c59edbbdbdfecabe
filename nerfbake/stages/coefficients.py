"""Transform the leaves of an octree to coefficients, and round these to multiples of a step."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from nerfbake import memory
from nerfbake.errors import InvalidScene, Problem
from nerfbake.kernels.maths.elementary import log
from nerfbake.kernels.maths.linear import cholesky, eigenvectors, product
from nerfbake.kernels.octree import haar
from nerfbake.kernels.octree.pyramid import mean_edge
from nerfbake.kernels.parallel import over_chunks
from nerfbake.scene.basis import renderable_basis
from nerfbake.scene.octree import SparseVoxelOctree
from nerfbake.scene.quantised_octree import MAX_VALUE, QuantisedOctree, unit_mixing, with_density

Floats = npt.NDArray[np.float64]
Rows = npt.NDArray[np.int64]

# The unit and the step of the density were measured on the chair at equal loss: a quarter of the unit costs 0.6 % of
# the bytes, three times the unit 3.8 %, and the colour's step 0.7 % (docs/tuning.md).
_DEPTH = 6  # number of voxels of unit density that have an optical depth of 1
_DENSITY_STEPS = 2  # step of density / step of colour
_SAMPLE = 1 << 17  # largest number of leaves from which the channels are computed
_CHUNK = 1 << 15  # leaves at a time
_ROUNDING = 32767  # largest entry of the mixing matrix
_LEAF_BYTES, _NUMBER_BYTES = 0.13, 0.5  # of a coded octree, for each leaf and for each integer that is not 0
STEPS = (1e-4, 16.0)  # smallest and largest step of a search


@dataclass(frozen=True, eq=False)
class Coefficients:
    """The transformed leaves of an octree, before rounding.

    points  (m, 3B + 1) float32: the coefficients; points[merges.rows] are the rows of QuantisedOctree.values
    merges, blocks  the pairs of the Haar transform; leaf (m,) int64: the leaf number of each point

    The other fields are those of QuantisedOctree.
    """

    octree: SparseVoxelOctree
    masks: npt.NDArray[np.uint8]
    points: npt.NDArray[np.float32]
    merges: haar.Merges
    blocks: haar.HaarBlocks
    leaf: Rows
    mixing: npt.NDArray[np.int16]
    mixing_scale: float
    density_scale: float

    def rounded(self, step: float) -> QuantisedOctree:
        """Round to the nearest multiple of a step of colour. Raises InvalidScene if integers would be too large."""
        steps, order = self._steps(step), self.merges.rows
        memory.require("the rounded leaves", 4 * self.points.size)
        values = np.empty(self.points.shape, np.int32)

        def fill(begin: int, end: int) -> None:
            part = np.rint(self.points[order[begin:end]] / steps)
            if (most := float(np.abs(part).max())) > MAX_VALUE:
                found = f"rounds coefficients to up to {most:g} steps"
                raise InvalidScene(Problem(f"a step of {step:g}", found, f"{MAX_VALUE:,}"))
            values[begin:end] = part

        over_chunks(fill, len(values), _CHUNK)
        return QuantisedOctree(
            size=self.octree.size,
            masks=self.masks,
            values=values,
            mixing=self.mixing,
            mixing_scale=self.mixing_scale,
            colour_step=step,
            density_step=step * _DENSITY_STEPS,
            density_scale=self.density_scale,
            data_format=self.octree.data_format,
            origin=self.octree.origin,
            voxel_size=self.octree.voxel_size,
        )

    def leaf_values(self, step: float) -> npt.NDArray[np.float32]:
        """Return rounded(step).leaf_values(), without the integers. Raises MemoryLimit."""
        memory.require("the leaves of the octree", self.points.size * 4)
        mixing = unit_mixing(self.mixing, self.mixing_scale)
        values, v = haar.restore_rounded(self.points, self._steps(step), self.merges, self.blocks, mixing, self.leaf)
        return with_density(values, v, self.density_scale)

    def estimated_size(self, step: float) -> float:
        """Return the estimated size in bytes of the octree with this step, as a .svoq with the range coder.

        For steps of 0.06 to 0.48, it was within 4 % for trained scenes of 256^3 and finer, and up to 16 % too large for
        one of 128^3.
        """
        sizes, every = self._sample
        numbers = every * (len(sizes) - int(np.searchsorted(sizes, step / 2)))
        return _LEAF_BYTES * len(self.points) + _NUMBER_BYTES * numbers

    def step_for_size(self, size: float) -> float:
        """Return the step within STEPS whose estimated size is nearest to `size` bytes."""
        sizes, every = self._sample
        numbers = int((size - _LEAF_BYTES * len(self.points)) / _NUMBER_BYTES) // every
        if numbers <= 0:
            return STEPS[1]
        return min(max(2 * float(sizes[max(len(sizes) - numbers, 0)]), STEPS[0]), STEPS[1])

    @cached_property
    def _sample(self) -> tuple[npt.NDArray[np.float32], int]:
        """The rising sizes of the coefficients in every k-th row, those of density in units of its step; and k."""
        every = -(-len(self.points) // _SAMPLE)
        sizes = np.abs(self.points[::every])
        sizes[:, -1] /= _DENSITY_STEPS
        return np.sort(sizes, axis=None), every

    def _steps(self, step: float) -> Floats:
        steps = np.full(self.points.shape[1], step)
        steps[-1] *= _DENSITY_STEPS
        return steps


def visible_leaves(octree: SparseVoxelOctree) -> Rows:
    """Return the rows of the leaves with a density above 0, breadth-first: the leaves of build_field(octree).

    Raises InvalidScene for an octree that cannot be rendered, or without such a leaf.
    """
    renderable_basis(octree.data_format)
    octree.require_usable()
    rows = np.flatnonzero(octree.childless & (octree.sigma > 0))
    if not len(rows):
        raise InvalidScene(Problem("the octree", "is empty", "a leaf with a density above 0"))
    return rows


def transform(
    octree: SparseVoxelOctree, rows: Rows, values: npt.NDArray[np.float32], keep: Rows, gram: Floats
) -> Coefficients:
    """Transform some of the octree's visible leaves; all other leaves are treated as empty.

    The values of a leaf go through the metric of `gram` and a Karhunen-Loeve transform, then the leaves go through the
    region-adaptive Haar transform. rows, values: visible_leaves() and their values; keep: which of them, ascending.
    gram (B, B): Importance.gram. Raises MemoryLimit.
    """
    width = octree.data_dim
    memory.require("the transformed leaves", len(keep) * width * 4 + _SAMPLE * width * 16)
    masks = _masks(octree, rows[keep])
    levels = haar.levels_of(masks, octree.grid_level)
    codes, leaf = haar.leaf_codes(levels, octree.grid_level)
    merges = haar.merges_of(codes, octree.grid_level)
    blocks = haar.blocks_of(merges)
    mixing, mixing_scale, unmixing = _channels(values[keep[:: -(-len(keep) // _SAMPLE)]], gram)
    density_scale = 1 / (_DEPTH * mean_edge(octree.voxel_size))
    points = np.empty((len(keep), width), np.float32)

    def fill(begin: int, end: int) -> None:
        part = values[keep[leaf[begin:end]]].astype(np.float64)
        points[begin:end, :-1] = product(part[:, :-1], unmixing.T)
        points[begin:end, -1] = log(1 + part[:, -1] / density_scale)

    over_chunks(fill, len(keep), _CHUNK)
    haar.forward(points, merges, blocks)
    return Coefficients(octree, masks, points, merges, blocks, leaf, mixing, mixing_scale, density_scale)


def _masks(octree: SparseVoxelOctree, rows: Rows) -> npt.NDArray[np.uint8]:
    """Return a child mask (uint8) for each node above the last level that has one of these leaves below it."""
    alive = np.zeros(octree.n, bool)
    alive[rows] = True
    sizes = octree.level_sizes
    ends = np.cumsum(sizes)
    for begin, end in zip((ends - sizes)[-2::-1], ends[-2::-1], strict=True):
        children = octree.node_children[begin:end]
        alive[begin:end] |= (alive[children] & (children != 0)).any(axis=1)
    above = int(ends[min(octree.grid_level, len(ends)) - 1]) if octree.grid_level else 0
    children = np.zeros((above, 8), np.int32)
    children[: octree.c] = octree.node_children[:above]
    kept = np.packbits(alive[children] & (children != 0), axis=1, bitorder="little")[:, 0]
    return kept[alive[:above]]


def _channels(some: npt.NDArray[np.float32], gram: Floats) -> tuple[npt.NDArray[np.int16], float, Floats]:
    """Return the mixing matrix (3B, 3B) from channels to coefficients as integers, their unit, and the exact inverse.

    some (k, 3B + 1): values of a sample of the leaves. With gram = L L^T, the squared norm of L^T c is the mean square
    of the colour with coefficients c.
    """
    B = len(gram)
    L = cholesky(gram)
    seen, unseen = np.zeros((3 * B, 3 * B)), np.zeros((3 * B, 3 * B))
    for c in range(0, 3 * B, B):
        seen[c : c + B, c : c + B] = L.T
        unseen[c : c + B, c : c + B] = _inverse_triangle(L).T
    looks = product(some[:, :-1].astype(np.float64), seen.T)
    looks -= looks.sum(axis=0) / len(looks)
    _, vectors = eigenvectors(product(looks.T, looks))
    exact, back = product(unseen, vectors), product(vectors.T, seen)
    scale = float(np.abs(exact).max()) / _ROUNDING
    mixing = np.rint(exact / scale).astype(np.int16)
    used = mixing * scale
    for _ in range(3):  # Newton's method from the inverse before rounding: each step doubles the correct digits
        back = 2 * back - product(product(back, used), back)
    return mixing, scale, back


def _inverse_triangle(L: Floats) -> Floats:
    """Return the inverse of a lower triangular matrix."""
    n = len(L)
    found = np.zeros((n, n))
    for j in range(n):
        found[j, j] = 1 / L[j, j]
        for i in range(j + 1, n):
            total = 0.0
            for k in range(j, i):
                total += L[i, k] * found[k, j]
            found[i, j] = -total / L[i, i]
    return found
