"""A compressed octree as integers: which nodes exist, and the coefficients of a transform."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from nerfbake import memory
from nerfbake.errors import InvalidScene, Problem
from nerfbake.kernels.maths.elementary import cast, expm1
from nerfbake.kernels.octree import haar
from nerfbake.kernels.octree.haar import restore
from nerfbake.kernels.octree.node_values import LeafRows, NodeRows
from nerfbake.kernels.octree.pyramid import Level, children_table, mean_edge
from nerfbake.kernels.parallel import over_chunks
from nerfbake.kernels.soundness import plural
from nerfbake.scene.base import Scene, edge_problems, place_problems, require_shape, set_vectors
from nerfbake.scene.basis import Basis, parse_basis
from nerfbake.scene.octree import SparseVoxelOctree, whole_size

MAX_VALUE = (1 << 30) - 1  # largest coefficient, in steps
STEPS = (1e-9, 1e9)  # range of steps and scales
_CHUNK = 1 << 15  # leaves at a time


@dataclass(frozen=True, eq=False, repr=False)
class QuantisedOctree(Scene):
    """The m leaves of an octree over a grid of W x H x D voxels, transformed and quantised to integers.

    size           (W, H, D) voxels along x, y, z, as in SparseVoxelOctree
    masks          (c,) uint8: the children of each node above the level of single voxels, breadth-first; bit x + 2y +
                   4z for the octant; 0 = a leaf
    values         (m, 3B + 1) int32, in steps: the channels of colour in falling variance, then density. Row 0 is the
                   sum of all leaves; then there is a row for each pair of the region-adaptive Haar transform
                   (kernels.octree.haar), from the coarsest binary level to the finest, in Morton order within each
    mixing         (3B, 3B) int16: the basis's coefficients (rows; red, green, blue) = mixing_scale * mixing * channels
    mixing_scale   the unit of `mixing`
    colour_step    quantisation step of every channel of colour
    density_step   quantisation step of the channel of density v
    density_scale  sigma = density_scale * (e^v - 1), in 1/world unit
    data_format    SHk or RGBA
    origin, voxel_size  (3,) float64: world = origin + voxel * voxel_size

    >>> from nerfbake import build_octree, compress_octree, sample_n3tree
    >>> octree = build_octree(sample_n3tree(resolution=16))
    >>> quantised = compress_octree(octree, coded_size=lambda quantised: quantised.m, step=0.1).quantised
    >>> quantised.values.shape, quantised.restored().data_format
    ((545, 28), 'SH9')
    """

    size: tuple[int, int, int]
    masks: npt.NDArray[np.uint8]
    values: npt.NDArray[np.int32]
    mixing: npt.NDArray[np.int16]
    mixing_scale: float
    colour_step: float
    density_step: float
    density_scale: float
    data_format: str
    origin: npt.NDArray[np.float64] = field(default_factory=lambda: np.zeros(3))
    voxel_size: npt.NDArray[np.float64] = field(default_factory=lambda: np.ones(3))

    def __post_init__(self) -> None:
        object.__setattr__(self, "size", whole_size(self.size))
        if (basis := parse_basis(self.data_format)).kind not in ("SH", "RGBA"):
            raise InvalidScene(Problem("data_format", f"is {self.data_format}", "SHk or RGBA"))
        D, m = basis.data_dim, len(self.values)
        for name, shape, dtype in (
            ("masks", self.masks.shape[:1], np.uint8),
            ("values", (max(m, 1), D), np.int32),
            ("mixing", (D - 1, D - 1), np.int16),
        ):
            require_shape(name, getattr(self, name), shape, dtype)
        for name in ("mixing_scale", "colour_step", "density_step", "density_scale"):
            object.__setattr__(self, name, float(getattr(self, name)))
            if not STEPS[0] <= getattr(self, name) <= STEPS[1]:
                raise InvalidScene(Problem(name, f"is {getattr(self, name):g}", f"{STEPS[0]:g} to {STEPS[1]:g}"))
        set_vectors(self, "origin", "voxel_size")

    def __str__(self) -> str:
        size = "x".join(map(str, self.size))
        return f"{self.data_format} octree of {size}, {self.m:,} leaves, step {self.colour_step:g}"

    @property
    def m(self) -> int:
        """Number of leaves."""
        return len(self.values)

    @property
    def basis(self) -> Basis:
        return parse_basis(self.data_format)

    @property
    def grid_level(self) -> int:
        """The level whose nodes are single voxels, which have no masks: log2 of the root cube's edge."""
        return max(edge - 1 for edge in self.size).bit_length()

    @property
    def level_sizes(self) -> list[int]:
        """Nodes in each level from the root to the last non-empty one. The masks must be valid."""
        return mask_levels(self.masks, self.grid_level)

    @property
    def steps(self) -> npt.NDArray[np.float64]:
        """(3B + 1,) the quantisation step of each channel."""
        return np.append(np.full(3 * self.basis.size, self.colour_step), self.density_step)

    # -- soundness ---------------------------------------------------------------------------------------------
    def structure_problems(self) -> list[Problem]:
        problems = place_problems("origin", self.origin) + edge_problems("voxel_size", self.voxel_size)
        sizes = mask_levels(self.masks, self.grid_level)
        above = sum(sizes[: self.grid_level])
        if above != len(self.masks):
            problems.append(
                Problem("masks", f"have {plural(len(self.masks), 'node')}", f"{above:,} above the last level")
            )
            return problems
        leaves = sum(sizes) - int(np.count_nonzero(self.masks))
        if leaves != self.m:
            found = f"have {plural(self.m, 'row')}"
            problems.append(Problem("values", found, f"{leaves:,}, one per leaf"))
        return problems

    def value_problems(self) -> list[Problem]:
        most = max(int(self.values.max()), -int(self.values.min()))
        return [Problem("values", f"reach {most:,}", f"{MAX_VALUE:,}")] if most > MAX_VALUE else []

    # -- the octree again --------------------------------------------------------------------------------------
    def leaf_values(self) -> npt.NDArray[np.float32]:
        """The values of the leaves, (m, 3B + 1) float32, breadth-first; the same bits on every CPU.

        The inverse Haar transform is applied to the coefficients times their steps. A coefficient of the basis is then
        the sum over the channels, from the first to the last, of the channel times (mixing times mixing_scale). The
        density is density_scale * expm1(v), with kernels.maths.elementary's expm1, and 0 for negative v. All operations
        are float64, one after the other, and the result is rounded to float32. The structure must be valid.
        """
        return self._leaf_values(haar.levels_of(self.masks, self.grid_level))

    def _leaf_values(self, levels: list[Level]) -> npt.NDArray[np.float32]:
        codes, leaf = haar.leaf_codes(levels, self.grid_level)
        merges = haar.merges_of(codes, self.grid_level)
        del codes
        memory.require("the leaves of the octree", self.m * self.values.shape[1] * (8 + 4))
        return with_density(
            *restore(self.values, self.steps, merges, unit_mixing(self.mixing, self.mixing_scale), leaf),
            self.density_scale,
        )

    def restored(self) -> SparseVoxelOctree:
        """Return the decoded octree in layout `full`. Raises InvalidScene, MemoryLimit.

        Inner nodes are computed by build_octree's rule, with the width of a voxel as that of the finest cell.
        """
        self.require_usable()
        levels = haar.levels_of(self.masks, self.grid_level)
        leaves = LeafRows(self._leaf_values(levels), mean_edge(self.voxel_size))
        return SparseVoxelOctree(
            size=self.size,
            node_children=children_table(levels, all_slots=True),
            node_data=NodeRows(levels, leaves),
            data_format=self.data_format,
            origin=self.origin,
            voxel_size=self.voxel_size,
        )


def unit_mixing(mixing: npt.NDArray[np.int16], mixing_scale: float) -> npt.NDArray[np.float64]:
    """(3B, 3B) the coefficients (columns) of each channel (rows)."""
    return np.ascontiguousarray((mixing * mixing_scale).T)


def with_density(
    values: npt.NDArray[np.float32], v: npt.NDArray[np.float64], density_scale: float
) -> npt.NDArray[np.float32]:
    """Fill the last column of values (m, 3B + 1) with the densities of the channel v (m,), and return the values."""

    def fill(begin: int, end: int) -> None:
        with np.errstate(over="ignore"):  # becomes infinite, which the octree's check rejects
            values[begin:end, -1] = cast(density_scale * expm1(np.maximum(v[begin:end], 0)), np.float32)

    over_chunks(fill, len(values), _CHUNK)
    return values


def mask_levels(masks: npt.NDArray[np.uint8], levels: int) -> list[int]:
    """Nodes in each level according to these masks, the root's first.

    The sum of the first `levels` entries is the expected number of masks. The list ends where the masks end.
    """
    sizes, first = [1], 0
    while len(sizes) <= levels and sizes[-1] and first + sizes[-1] <= len(masks):
        first += sizes[-1]
        sizes.append(int(np.bitwise_count(masks[first - sizes[-1] : first]).sum()))
    return sizes if sizes[-1] else sizes[:-1]
