"""The contents of a .vdb or .nvdb file: grids with transforms, and the facts that restore an octree from them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import numpy.typing as npt

from nerfbake.errors import InvalidScene, Problem
from nerfbake.kernels.maths.affine import inverse, rotate
from nerfbake.kernels.soundness import plural
from nerfbake.scene.base import MAX_WORLD, Scene, place_problems
from nerfbake.scene.octree import Layout
from nerfbake.scene.vdb import IndexGrid, VdbTree

Up = Literal["y", "z"]
Transform = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class OctreeFrame:
    """The fields of a SparseVoxelOctree except for its nodes."""

    size: tuple[int, int, int]
    data_format: str
    layout: Layout
    origin: npt.NDArray[np.float64]
    voxel_size: npt.NDArray[np.float64]
    extra_data: npt.NDArray[np.float32] | None = None


@dataclass(frozen=True, eq=False, repr=False)
class Volume(Scene):
    """Grids in one world.

    grids      VdbTree and IndexGrid, each with its own topology
    transform  (3, 4) float64: world = transform @ (x, y, z, 1), for the CENTRE of a voxel (VDB's samples are there),
               for all grids without a `place` of their own
    frame      restores the octree that the voxels were made from; None for files of other programs
    checksum   the file's kind of checksum: 'none', 'half' or 'full'
    unread     grids of the file that could not be read: for each what it is, and what is allowed

    >>> from nerfbake import build_octree, build_vdb, sample_n3tree
    >>> volume = build_vdb(build_octree(sample_n3tree(resolution=8)))
    >>> volume.labels
    ['density', 'Cd']
    >>> volume.grid("density").sample(volume.index_of([[0.0, 0.0, 99.0]]))
    array([[0.]], dtype=float32)
    """

    grids: tuple[VdbTree | IndexGrid, ...]
    transform: Transform
    frame: OctreeFrame | None = None
    checksum: str = "none"
    unread: tuple[Problem, ...] = ()

    def __post_init__(self) -> None:
        for transform in (self.transform, *self.transforms):
            if transform.shape != (3, 4) or transform.dtype != np.float64:
                found = f"has shape {transform.shape}, dtype {transform.dtype}"
                raise InvalidScene(Problem("transform", found, "(3, 4) float64"))
        if not self.grids:
            raise InvalidScene(Problem("the volume", "has no grids", "one or more"))

    def __str__(self) -> str:
        first = self.grids[0]
        kind = "index grid" if isinstance(first, IndexGrid) else plural(len(self.grids), "grid").removeprefix("1 ")
        tiles = sum(first.topology.tile_counts)
        held = plural(first.topology.m, "voxel") + (f" and {plural(tiles, 'tile')}" if tiles else "")
        return f"VDB {kind} ({', '.join(self.labels)}), {held}, {first.dtype}"

    # -- grids by name -----------------------------------------------------------------------------------------
    @property
    def labels(self) -> list[str]:
        """The name of each grid; name[i], as in OpenVDB's tools, if it has no name or a name that is not unique."""
        names = [grid.name for grid in self.grids]
        held, met, labels = Counter(names), Counter[str](), []
        for name in names:
            labels.append(name if name and held[name] == 1 else f"{name}[{met[name]}]")
            met[name] += 1
        return labels

    def grid(self, name: str) -> VdbTree | IndexGrid:
        """Return the first grid of this name. Raises InvalidScene if there is none."""
        for grid in self.grids:
            if grid.name == name:
                return grid
        raise InvalidScene(Problem("the volume", f"has no grid {name!r}", ", ".join(self.labels)))

    def density(self) -> VdbTree:
        """Return the grid `density`, or else the only grid with one channel.

        Raises InvalidScene if there is no such grid, or if it is a level set.
        """
        scalars = [grid for grid in self.grids if isinstance(grid, VdbTree) and grid.values.shape[1] == 1]
        named = [grid for grid in scalars if grid.name == "density"]
        fogs = [grid for grid in scalars if grid.grid_class != "level set"]
        if not named and len(fogs) != 1 and len(scalars) != 1:
            allowed = "density among them, or index; `grid=NAME` for one of them"
            raise InvalidScene(Problem("the volume", f"has the grids {', '.join(self.labels)}", allowed))
        grid = (named or fogs or scalars)[0]
        if grid.grid_class == "level set":
            allowed = "a fog volume; level sets only for info, check, and convert between .vdb, .nvdb, .vdb.npz"
            raise InvalidScene(Problem(f"grid {grid.name!r}", "is a level set", allowed))
        return grid

    def only(self, wanted: Sequence[str]) -> Volume:
        """A volume of these grids alone, given by label or by number in the file, from 0. Raises InvalidScene."""
        labels, grids = self.labels, []
        for name in wanted:
            short = name.isascii() and name.isdecimal() and len(name) < 10
            if name not in labels and not (short and int(name) < len(labels)):
                raise InvalidScene(Problem("the volume", f"has no grid {name!r}", ", ".join(labels)))
            grids.append(self.grids[labels.index(name) if name in labels else int(name)])
        return replace(self, grids=tuple(grids), unread=())

    # -- places ------------------------------------------------------------------------------------------------
    @property
    def transforms(self) -> list[Transform]:
        """The transform (3, 4) of each grid."""
        return [self.transform_of(grid) for grid in self.grids]

    def transform_of(self, grid: VdbTree | IndexGrid) -> Transform:
        place = grid.place if isinstance(grid, VdbTree) else None
        return self.transform if place is None else place

    @property
    def voxel_size(self) -> npt.NDArray[np.float64]:
        """(3,) lengths of a voxel's edges in the world."""
        return edges_of(self.transform)

    def index_of(self, points: npt.ArrayLike) -> npt.NDArray[np.float64]:
        """Convert world coordinates (..., 3) to voxels, for a grid's sample()."""
        apart = np.asarray(points, np.float64) - self.transform[:, 3]
        return np.asarray(rotate(apart, inverse(self.transform[:, :3])), np.float64)

    # -- other volumes -----------------------------------------------------------------------------------------
    def turned(self) -> Volume:
        """Convert a volume whose up axis is y to z up: (x, y, z) becomes (x, -z, y), in the transforms only."""
        grids = tuple(
            replace(grid, place=_turned(grid.place)) if isinstance(grid, VdbTree) and grid.place is not None else grid
            for grid in self.grids
        )
        return replace(self, grids=grids, transform=_turned(self.transform))

    # -- soundness ---------------------------------------------------------------------------------------------
    def structure_problems(self) -> list[Problem]:
        return self._world_problems() + [problem for grid in self.grids for problem in grid.structure_problems()]

    def _world_problems(self) -> list[Problem]:
        """Transforms that are out of range or singular."""
        problems = []
        for transform in {each.tobytes(): each for each in self.transforms}.values():
            with np.errstate(all="ignore"):
                back = inverse(transform[:, :3])
            astray = place_problems("transform", transform)
            if not astray and not (np.abs(back) <= MAX_WORLD).all():
                allowed = f"a voxel with a volume, its edges from {1 / MAX_WORLD:g}"
                astray = [Problem("transform", "cannot be inverted", allowed)]
            problems += astray
        return problems

    def value_problems(self) -> list[Problem]:
        """Values that cannot be rendered."""
        return [problem for grid in self.grids for problem in grid.value_problems()]

    def unread_problems(self) -> list[Problem]:
        """Grids of the file that could not be read."""
        return list(self.unread)


def edges_of(transform: Transform) -> npt.NDArray[np.float64]:
    """(3,) lengths of a voxel's edges in the world; infinite if their squares overflow float64."""
    with np.errstate(over="ignore"):
        lengths: npt.NDArray[np.float64] = np.sqrt((transform[:, :3] ** 2).sum(axis=0))
    return lengths


def _turned(transform: Transform) -> Transform:
    x, y, z = transform
    return np.stack([x, -z, y])
