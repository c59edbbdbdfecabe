"""The cells of a lattice in which a trained function has a density, and what cameras see of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake import memory, progress
from nerfbake.errors import InvalidScene, Problem
from nerfbake.kernels.arrays import Bits, Floats, Ints, Points, Singles, as_input
from nerfbake.kernels.dilation import dilated
from nerfbake.kernels.fit.plan import FinalBricks, number_cells, plan_of_kept, plan_of_solid
from nerfbake.kernels.network.visibility import CellLight, SeenBricks, see_cells
from nerfbake.kernels.parallel import cores, over_chunks
from nerfbake.kernels.soundness import MAX_EDGE
from nerfbake.scene.brick_field import EDGE, MAX_RESOLUTION
from nerfbake.scene.camera import Camera, Cameras
from nerfbake.scene.function_field import FunctionField
from nerfbake.stages._bricks import lattice_frame

MOST_CAMERAS = 128  # of a larger capture, those that are farthest from each other
_SPLIT = 0.01  # optical thickness of a cell of half the resolution, from which it and its neighbours are split
_LEAST = 0.002  # optical thickness of a cell that is kept until rays decide
_BLOCK = 1 << 16  # points that are evaluated at a time
_RAYS_A_CELL = 2.0  # of a camera, per face of a cell
_ALL_RAYS = 64.0  # of all cameras together, per face of a cell
_CELL_BYTES = 60  # per cell of a brick, while the bricks are made
_RAY_BYTES = 120


class FunctionCells(NamedTuple):
    """Cells of a lattice with shells (see BrickField), in the order of its bricks.

    made   their bricks
    sigma  (n,) densities per world unit
    low, size, width  as lattice_frame() returns them
    """

    made: FinalBricks
    sigma: Singles
    low: Points
    size: Points
    width: Floats

    @property
    def n(self) -> int:
        return len(self.sigma)

    @property
    def shells(self) -> int:
        return len(self.low)

    def shell_of(self) -> Ints:
        """(n,) the shell of each cell."""
        r = self.made.top.shape[1]
        return np.repeat(np.argwhere(self.made.top >= 0)[:, 0] // r, np.diff(self.made.first))

    def centres(self, begin: int = 0, end: int | None = None) -> Points:
        """(m, 3) the centres of some cells, or of all, in the world."""
        first, r = self.made.first, self.made.top.shape[1]
        cells = np.arange(begin, self.n if end is None else end)
        brick = np.argwhere(self.made.top >= 0)[np.searchsorted(first, cells, side="right") - 1]
        place = self.made.places[cells].astype(np.int64) >> 1
        within = np.stack([place >> 6, place >> 3 & 7, place & 7], axis=1)
        shell = brick[:, 0] // r
        return np.asarray(self.low[shell] + (8 * (brick % r) + within + 0.5) * self.size[shell], np.float64)

    def in_wall(self, wall: Wall) -> tuple[Ints, Ints]:
        """Return the cells (k,) that belong to a wall, and the number of each in it."""
        r = self.made.top.shape[1]
        bricks = np.argwhere(self.made.top >= 0)
        outermost = int(np.count_nonzero(bricks[:, 0] < (self.shells - 1) * r))
        first = int(self.made.first[outermost])
        brick = np.repeat(bricks[outermost:] % r, np.diff(self.made.first[outermost:]), axis=0)
        place = self.made.places[first:].astype(np.int64) >> 1
        x, y, z = (8 * brick + np.stack([place >> 6, place >> 3 & 7, place & 7], axis=1)).T
        places = (x * (8 * r) + y) * (8 * r) + z
        number = np.minimum(np.searchsorted(wall.places, places), len(wall.places) - 1)
        held = np.flatnonzero(wall.places[number] == places)
        return first + held, number[held]

    def kept(self, keep: Bits) -> FunctionCells:
        """Return the chosen cells (n,). Raises InvalidScene if there are none."""
        if not keep.any():
            raise InvalidScene(Problem("the field", "has no density that a camera sees in the box", "another box"))
        made = number_cells(plan_of_kept(self.made.top, self.made.slots, self.made.first, keep))
        return self._replace(made=made, sigma=self.sigma[made.row])


class Wall(NamedTuple):
    """Cells at the end of the outermost shell, which show what lies beyond.

    places     (w,) their places in that shell, x-major, ascending
    thickness  (w,) their optical thickness
    colours    (w, 3) sRGB
    """

    places: Ints
    thickness: Singles
    colours: Singles


def find_cells(
    field: FunctionField, box: Points, resolution: int, shells: int, sigma_min: float, wall: Wall | None = None
) -> FunctionCells:
    """Return the cells that have a density: at their centres it is at least sigma_min, and 0.2 % of a ray are absorbed.

    The lattice is evaluated at half of the resolution; cells with a density there, and their neighbours, are split.
    wall: its cells are at least as thick as it says. Raises InvalidScene if there are none; MemoryLimit.
    """
    if not EDGE <= resolution <= MAX_RESOLUTION or resolution & (resolution - 1):
        allowed = f"a power of two, {EDGE} to {MAX_RESOLUTION}"
        raise InvalidScene(Problem("resolution", f"is {resolution}", allowed))
    R = resolution
    memory.require(f"a lattice of {R}^3 cells in {shells} shells", 3 * shells * R**3)
    low, size, width = lattice_frame(box, R, shells)
    solid = np.zeros((shells * R, R, R), bool)
    with progress.part(0, 0.5):
        for shell in progress.each(range(shells)):
            solid[shell * R : (shell + 1) * R] = _split(field, low[shell], 2 * size[shell], 2 * width[shell], R, shell)
    if wall is not None:
        solid[-R:].reshape(-1)[wall.places] = True
    count = int(np.count_nonzero(solid))
    memory.require(f"{count:,} cells", _CELL_BYTES * count)
    made = number_cells(plan_of_solid(solid))
    del solid
    cells = FunctionCells(made, np.zeros(len(made.row), np.float32), low, size, width)
    if cells.n:
        with progress.part(0.5, 1):
            for begin in progress.each(range(0, cells.n, _BLOCK)):
                end = min(begin + _BLOCK, cells.n)
                cells.sigma[begin:end] = field.density(cells.centres(begin, end))[0]
    if wall is not None:
        held, number = cells.in_wall(wall)
        cells.sigma[held] = np.maximum(cells.sigma[held], wall.thickness[number] / np.float32(width[-1]))
    thickness = cells.sigma * width.astype(np.float32)[cells.shell_of()]
    return cells.kept((thickness > _LEAST) & (cells.sigma >= sigma_min))


def _split(field: FunctionField, low: Floats, size: Floats, width: float, R: int, shell: int) -> Bits:
    """Return the cells (R, R, R) of a shell that may have a density. size, width: of cells twice as wide."""
    H = R // 2
    held, inner = np.zeros((H, H, H), bool), np.zeros((H, H, H), bool)
    if shell:  # this part belongs to the smaller shells
        inner[H // 4 : H - H // 4, H // 4 : H - H // 4, H // 4 : H - H // 4] = True
    planes = max(1, _BLOCK // (H * H))
    for x in progress.each(range(0, H, planes)):
        cells = np.argwhere(~inner[x : x + planes]) + np.array([x, 0, 0])
        for begin in range(0, len(cells), _BLOCK):
            some = cells[begin : begin + _BLOCK]
            sigma = field.density(low + (some + 0.5) * size)[0]
            held[tuple(some[sigma * np.float32(width) > _SPLIT].T)] = True
    held = dilated(held) & ~inner
    return np.repeat(np.repeat(np.repeat(held, 2, 0), 2, 1), 2, 2)


class SeenCells(NamedTuple):
    """What cameras see of cells.

    largest  (n,) the largest share of a ray's light that each cell absorbs
    total    (n,) the sum of these shares, in 1 / LIGHT
    through  (C, n) for each camera the largest transmittance of its rays in front of each cell, 0 to 255
    """

    largest: Singles
    total: Ints
    through: npt.NDArray[np.uint8]


def see(
    cells: FunctionCells, views: Sequence[Camera], near: float, *, total: bool = False, through: bool = False
) -> SeenCells:
    """Send rays from all cameras through the cells. near: where rays begin, in world units. Raises MemoryLimit.

    The result does not depend on the number of threads.
    """
    n, threads = cells.n, min(len(views), cores())
    pixels = max(view.width * view.height for view in views)
    need = threads * (n * (4 + 8 * total) + pixels * _RAY_BYTES)
    kept = np.zeros((len(views) if through else 0, n if through else 0), np.uint8)
    with memory.lent("the rays of the cameras", need + len(views) * n * through):
        if through:
            kept = np.zeros((len(views), n), np.uint8)
        bricks = SeenBricks(*cells.made[:3], cells.sigma, as_input(cells.low), as_input(cells.size))
        spare: list[CellLight] = []  # one buffer per thread, reused for its next camera
        nothing = np.zeros(0, np.uint8)

        def work(begin: int, end: int) -> None:
            try:
                light = spare.pop()
            except IndexError:
                light = CellLight(np.zeros(n, np.float32), np.zeros(n if total else 0, np.int64))
            for i in range(begin, end):
                eye, looks = views[i].rays()
                see_cells(bricks, eye.copy(), looks, float(near), light, kept[i] if through else nothing)
            spare.append(light)
            progress.report(end / len(views))

        over_chunks(work, len(views), 1)
        largest, sums = spare[0]
        for other in spare[1:]:
            np.maximum(largest, other.largest, out=largest)
            sums += other.total
        return SeenCells(largest, sums, kept)


def spread_cameras(cameras: Cameras) -> Cameras:
    """Return at most MOST_CAMERAS cameras, ordered so that each is as far as possible from all before it.

    Distances are those of positions, relative to their spread, and of viewing directions.
    """
    eyes = cameras.eyes
    spread = float(np.sqrt(np.square(eyes - eyes.mean(axis=0)).sum(axis=1)).max())
    places = np.concatenate([eyes / max(spread, 1e-300), cameras.axes], axis=1)
    away, order = np.full(len(places), np.inf), [0]
    while len(order) < min(len(places), MOST_CAMERAS):
        away = np.minimum(away, np.square(places - places[order[-1]]).sum(axis=1))
        away[order] = -1
        order.append(int(np.argmax(away)))
    return replace(cameras, cameras=tuple(cameras.cameras[i] for i in order))


def baking_views(cameras: Cameras, box: Points, resolution: int) -> list[Camera]:
    """Return the cameras with as many pixels as it takes to send two rays through each visible face of a cell.

    With many cameras, each has fewer.
    """
    edge, middle = float((box[1] - box[0]).mean()), box.mean(axis=0)
    away = np.maximum(np.sqrt(np.square(cameras.eyes - middle).sum(axis=1)), edge / 2)
    scales = np.array([camera.fx for camera in cameras.cameras]) / (np.sqrt(_RAYS_A_CELL) * away * resolution / edge)
    edges = np.array([(camera.width, camera.height) for camera in cameras.cameras]) / scales[:, None]
    counts = edges[:, 0] * edges[:, 1]
    most = 4 * _RAYS_A_CELL * resolution**2
    edges *= np.sqrt(np.minimum(1, most / counts))[:, None]
    counts = np.minimum(counts, most)
    edges *= np.sqrt(min(1.0, _ALL_RAYS * resolution**2 / counts.sum()))
    sizes = np.clip(np.ceil(edges), 1, MAX_EDGE).astype(np.int64).tolist()
    return [camera.resized(*size) for camera, size in zip(cameras.cameras, sizes, strict=True)]
