"""What a .vdb or .nvdb file holds: grids in one place of the world, and what an octree needs to come back."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from nerfbake.errors import InvalidScene, Problem
from nerfbake.kernels.affine import inverse, turned
from nerfbake.kernels.topology import plural
from nerfbake.scene.base import MAX_WORLD, place_problems
from nerfbake.scene.octree import Layout
from nerfbake.scene.vdb import IndexGrid, VdbTree

Up = Literal["y", "z"]


@dataclass(frozen=True, eq=False)
class OctreeFrame:
    """Of a SparseVoxelOctree all but its nodes; the fields are its own."""

    size: tuple[int, int, int]
    data_format: str
    layout: Layout
    origin: npt.NDArray[np.float64]
    voxel_size: npt.NDArray[np.float64]
    extra_data: npt.NDArray[np.float32] | None = None


@dataclass(frozen=True, eq=False)
class Volume:
    """Grids of one world transform.

    grids      VdbTree and IndexGrid, each with its own topology
    transform  (3, 4) float64: world = transform @ (x, y, z, 1), of a voxel's CENTRE (VDB's samples stand there)
    frame      what turns the voxels back into the octree they came from; None in files of other programs
    checksum   what the file said of itself: 'none', 'half' or 'full'
    """

    grids: tuple[VdbTree | IndexGrid, ...]
    transform: npt.NDArray[np.float64]
    frame: OctreeFrame | None = None
    checksum: str = "none"

    def __post_init__(self) -> None:
        if self.transform.shape != (3, 4) or self.transform.dtype != np.float64:
            found = f"has shape {self.transform.shape}, dtype {self.transform.dtype}"
            raise InvalidScene(Problem("transform", found, "(3, 4) float64"))
        if not self.grids:
            raise InvalidScene(Problem("the volume", "has no grids", "one or more"))

    def __str__(self) -> str:
        first = self.grids[0]
        names = ", ".join(grid.name for grid in self.grids)
        kind = "index grid" if isinstance(first, IndexGrid) else plural(len(self.grids), "grid").removeprefix("1 ")
        return f"VDB {kind} ({names}), {plural(first.topology.m, 'voxel')}, {first.values.dtype}"

    @property
    def voxel_size(self) -> npt.NDArray[np.float64]:
        """(3,) lengths of a voxel's edges in the world."""
        lengths: npt.NDArray[np.float64] = np.sqrt((self.transform[:, :3] ** 2).sum(axis=0))
        return lengths

    def grid(self, name: str) -> VdbTree | IndexGrid:
        """The first grid of this name. Raises InvalidScene if there is none."""
        for grid in self.grids:
            if grid.name == name:
                return grid
        raise InvalidScene(Problem("the volume", f"has no grid {name!r}", ", ".join(grid.name for grid in self.grids)))

    def index_of(self, points: npt.ArrayLike) -> npt.NDArray[np.float64]:
        """(..., 3) world coordinates -> voxels, for a grid's sample()."""
        apart = np.asarray(points, np.float64) - self.transform[:, 3]
        return np.asarray(turned(apart, inverse(self.transform[:, :3])), np.float64)

    def require_sound(self) -> None:
        """Raises InvalidScene with the first structural problem, if there is one."""
        if problems := self.structure_problems():
            raise InvalidScene(problems[0])

    def structure_problems(self) -> list[Problem]:
        return self._world_problems() + [problem for grid in self.grids for problem in grid.structure_problems()]

    def _world_problems(self) -> list[Problem]:
        """Transforms that nobody can calculate with, or that flatten the world."""
        if problems := place_problems("transform", self.transform):
            return problems
        with np.errstate(all="ignore"):
            back = inverse(self.transform[:, :3])
        if not (np.abs(back) <= MAX_WORLD).all():
            return [
                Problem("transform", "cannot be inverted", f"a voxel with a volume, its edges from {1 / MAX_WORLD:g}")
            ]
        return []

    def value_problems(self) -> list[Problem]:
        """Values that no renderer can use."""
        return [problem for grid in self.grids for problem in grid.value_problems()]

    def problems(self) -> list[Problem]:
        """Everything that is wrong; values are looked at once the structure is sound."""
        return self.structure_problems() or self.value_problems()
