"""What runs the steps of a fit: the CPU's kernels, or the passes on a graphics device.

A fit visits views, which changes the cells, and reads the cells back when it needs them. Nothing else in a fit depends
on which of the two it has.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import islice
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

import numpy as np

from nerfbake import memory
from nerfbake.device import fit
from nerfbake.device.fit import Losses, UploadedView
from nerfbake.kernels.arrays import Floats, Singles
from nerfbake.kernels.fit.bricks import ROW, TaskBuffers, new_batch
from nerfbake.kernels.fit.rays import SUMS, FitView, march_view
from nerfbake.kernels.fit.ties import Ties, tie_coefficients, tie_densities
from nerfbake.kernels.fit.update import LearningRates, take_steps
from nerfbake.kernels.parallel import in_order, prefetched
from nerfbake.scene.camera import Camera
from nerfbake.scene.views import Views
from nerfbake.stages._bricks import BrickCells
from nerfbake.stages._depth_map import DepthMap
from nerfbake.stages._ray_targets import KeptTargets, RayTargets, UsedPixels, ray_targets, used_pixels

if TYPE_CHECKING:
    from nerfbake.device.gpu import Buffer, Gpu

TASKS = 16  # tasks that share a view's pixels; more would not be faster on 16 cores, and would need more memory
_STEADY = 8  # views whose gains change together on a graphics device
_AHEAD = 8  # most pictures that are prepared for a graphics device at once


class Look(NamedTuple):
    """A look at a picture.

    view: its number; scale, samples, ring: as in ray_targets(). again: the same pixels come later in this stage.
    Between stages, new cells need the memory. tilt: of the rays of a pixel, see pinhole_directions(); rays through a
    lens have none.
    """

    view: int
    scale: int
    samples: int
    ring: int | None
    again: bool
    tilt: float = 0.0


class Visit(NamedTuple):
    """One visit of a view.

    gains (3,): the factor of each channel between the field's colours and the picture's, or None. steps: the rates of
    the steps. fresh: the blame of all cells starts at 0.
    """

    losses: Losses
    gains: Floats | None
    steps: LearningRates
    fresh: bool


class FitDevice(Protocol):
    """What runs the steps of a fit.

    begin      names the views, the depths that some of them show, and the looks of all visits in order
    size       number of visits that one call should make: between two calls, the fit can be stopped. steady: the same
               number for every call, because something depends on it
    visit      makes the next visits; returns the sums (visits, SUMS) of march_view() if `counted`
    measure    returns the mean squared error of each view
    rest       is called where a fit may be measured or stored: frees memory that only visits need
    read_back  makes the arrays of the cells current. After an error they are as they were before
    tie        pulls the values of the cells once towards those of their neighbours; interpolated densities stay
    """

    def begin(self, views: Views, depths: Mapping[int, DepthMap], looks: Iterator[Look]) -> None: ...

    def size(self, *, steady: bool) -> int: ...

    def visit(self, cells: BrickCells, visits: Sequence[Visit], *, counted: bool) -> Floats: ...

    def measure(self, views: Views, cells: BrickCells, samples: int, losses: Losses) -> list[float]: ...

    def rest(self) -> None: ...

    def read_back(self, cells: BrickCells) -> None: ...

    def tie(self, cells: BrickCells, ties: Ties) -> None: ...


def fit_device(gpu: Gpu | None) -> FitDevice:
    """Return what runs the steps of a fit: the passes on a graphics device, or None: the CPU's kernels."""
    return CpuFit() if gpu is None else GpuFit(gpu)


class CpuFit:
    """The CPU's kernels. The cells are always current."""

    def __init__(self) -> None:
        self._batch: TaskBuffers | None = None
        self._targets: KeptTargets | None = None
        self._looks: Iterator[RayTargets] = iter(())
        self._background = np.zeros(3, np.float32)

    def begin(self, views: Views, depths: Mapping[int, DepthMap], looks: Iterator[Look]) -> None:
        targets: KeptTargets | None = None

        def found() -> Iterator[RayTargets]:
            nonlocal targets
            for view, scale, samples, ring, again, tilt in looks:
                if targets is None:
                    targets = self._targets = KeptTargets(views, ring=ring, depths=depths)
                yield targets.of(view, scale=scale, samples=samples, keep=again, tilt=tilt)

        self._looks, self._background = prefetched(found()), np.array(views.background, np.float32)

    def size(self, *, steady: bool) -> int:
        return 1

    def visit(self, cells: BrickCells, visits: Sequence[Visit], *, counted: bool) -> Floats:
        return np.array([self._visit(cells, next(self._looks), each) for each in visits])

    def measure(self, views: Views, cells: BrickCells, samples: int, losses: Losses) -> list[float]:
        found, batch, background = [], None, np.array(views.background, np.float32)
        numbers = range(len(views.pictures))
        for looks in prefetched(ray_targets(views, each, scale=1, samples=samples, ring=None) for each in numbers):
            sums, batch = _marched(cells, batch, looks, background, losses, None)
            found.append(float(sums[0]) / max(3 * len(looks.pixels), 1))
            # Other tasks see the object in the next view: a new batch frees the memory of the rows these have used.
            batch = new_batch(TASKS, batch.base.shape[1], batch.rows.shape[1])
        return found

    def rest(self) -> None:
        self._batch = None
        memory.give_back()

    def read_back(self, cells: BrickCells) -> None:
        pass

    def tie(self, cells: BrickCells, ties: Ties) -> None:
        if ties.coefficients is not None:
            memory.require(f"tying {cells.n:,} cells", cells.bricks.values.nbytes)
            tie_coefficients(cells.bricks, cells.means, ties.coefficients)
        if not cells.bricks.smooth:
            tie_densities(cells.bricks, cells.means, ties.density, ties.edge)

    def _visit(self, cells: BrickCells, looks: RayTargets, visit: Visit) -> Floats:
        if visit.fresh:
            cells.seen[:, 1] = 0
        if not len(looks.pixels):
            return np.zeros(SUMS)
        if visit.gains is not None:
            ground, wanted = (1 - looks.targets[:, 3:]) * self._background, looks.targets.copy()
            wanted[:, :3] = (wanted[:, :3] - ground) / visit.gains.astype(np.float32) + ground
            looks = looks._replace(targets=wanted)
        sums, batch = _marched(cells, self._batch, looks, self._background, visit.losses, self._targets)
        self._batch = batch
        take_steps(cells.bricks, batch, looks.eye, cells.means, cells.seen, visit.steps)
        return sums


def _marched(
    cells: BrickCells,
    batch: TaskBuffers | None,
    looks: RayTargets,
    background: Singles,
    losses: Losses,
    targets: KeptTargets | None,
) -> tuple[Floats, TaskBuffers]:
    """Render a view's pixels. Returns the sums of march_view(), and a larger batch if the view needs one.

    targets: are given up if the batch needs their memory.
    """
    bricks, sums = cells.bricks, np.zeros((TASKS, SUMS))
    view = FitView(
        looks.eye,
        looks.directions,
        looks.targets,
        background,
        losses.alpha,
        losses.point,
        losses.distortion,
        losses.focus,
        losses.most,
        losses.most_mean,
        losses.depth if len(looks.distances) else 0.0,
        looks.distances,
    )
    capacity = max(4096, len(bricks.places) // 8)
    while True:
        if batch is None:
            size = TASKS * capacity * ROW * 4 + 4 * len(bricks.values)
            if targets is not None and memory.left() < size + targets.size:
                targets.give_up()
            memory.require(f"fitting {len(bricks.places):,} cells", size)
            batch = new_batch(TASKS, len(bricks.slots), capacity)
        march_view(bricks, batch, view, sums)
        capacity = int(batch.used.max())
        if capacity <= batch.rows.shape[1]:
            return sums.sum(axis=0), batch
        batch, capacity = None, capacity * 5 // 4


class GpuFit:
    """The passes on a graphics device. The pixels of each view are reduced and uploaded once for a scale."""

    def __init__(self, gpu: Gpu) -> None:
        self._passes = fit.FitPasses(gpu)
        self._looks: Iterator[UploadedView | None] = iter(())
        self._measured: tuple[Views, int, list[UploadedView]] | None = None
        self._cells: BrickCells | None = None  # on the device
        self._current = True  # the arrays of the cells are
        self._fresh = False

    def begin(self, views: Views, depths: Mapping[int, DepthMap], looks: Iterator[Look]) -> None:
        self._looks = _uploaded(self._passes, views, depths, looks)

    def size(self, *, steady: bool) -> int:
        return _STEADY if steady else self._passes.size()

    def visit(self, cells: BrickCells, visits: Sequence[Visit], *, counted: bool) -> Floats:
        sums, ready = np.zeros((len(visits), SUMS)), dict[int, fit.DeviceVisit]()
        for number, (visit, view) in enumerate(zip(visits, islice(self._looks, len(visits)), strict=True)):
            self._fresh |= visit.fresh
            if view is not None:
                gains = np.ones(3) if visit.gains is None else visit.gains
                samples = round(visit.steps.rays**0.5)
                ready[number] = fit.DeviceVisit(view, samples, visit.losses, gains, visit.steps, self._fresh)
                self._fresh = False
        if ready:
            self._upload(cells)
            self._current = False
            sums[list(ready)] = self._passes.visit(list(ready.values()), counted=counted)
        return sums

    def measure(self, views: Views, cells: BrickCells, samples: int, losses: Losses) -> list[float]:
        if self._measured is None or self._measured[0] is not views or self._measured[1] != samples:
            looks = (Look(number, 1, samples, None, True) for number in range(len(views.pictures)))
            seen = [view for view in _uploaded(self._passes, views, {}, looks) if view is not None]
            self._measured = views, samples, seen
        self._upload(cells)
        seen = self._measured[2]
        visits = [fit.DeviceVisit(view, samples, losses, np.ones(3), None) for view in seen]
        sums = self._passes.visit(visits, counted=True)
        errors = [float(own) / (3 * view.size) for own, view in zip(sums[:, 0], seen, strict=True)]
        return errors + [0.0] * (len(views.pictures) - len(seen))

    def rest(self) -> None:
        pass

    def read_back(self, cells: BrickCells) -> None:
        if self._cells is cells and not self._current:
            self._passes.read_back(cells.bricks, cells.means, cells.seen)
            self._current = True

    def tie(self, cells: BrickCells, ties: Ties) -> None:
        self._upload(cells)
        self._current = False
        self._passes.tie(ties)

    def _upload(self, cells: BrickCells) -> None:
        if self._cells is not cells:
            self._passes.upload(cells.bricks, cells.means, cells.seen)
            self._cells, self._current = cells, True


def _uploaded(
    passes: fit.FitPasses, views: Views, depths: Mapping[int, DepthMap], looks: Iterator[Look]
) -> Iterator[UploadedView | None]:
    """Yield the pixels of each look on the device, or None if it has none; the next ones are made in the background."""
    held: dict[Any, UploadedView | None] = {}
    bent: dict[Any, Buffer] = {}
    scale = 0
    for look, key, made in in_order(_reductions(views, depths, looks), most=_AHEAD):
        if look.scale != scale:
            held, scale = {}, look.scale
        if made is not None:
            held[key] = _upload(passes, views, made, look.samples, bent)
        found = held[key]
        yield None if found is None else found._replace(tilt=look.tilt)


def _reductions(
    views: Views, depths: Mapping[int, DepthMap], looks: Iterator[Look]
) -> Iterator[Callable[[], tuple[Look, Any, UsedPixels | None]]]:
    """Yield the work of each look: it returns the look, a key of its pixels, and the pixels if they are new."""
    known, scale = set[Any](), 0
    for look in looks:
        if look.scale != scale:  # pictures of the scale before are not needed again
            known, scale = set(), look.scale
        bends = views.cameras.cameras[look.view].bends
        key = look.view, look.scale, look.ring, look.samples if bends else 0
        yield partial(_reduced, views, depths.get(look.view), look, key, new=key not in known)
        known.add(key)


def _reduced(
    views: Views, depths: DepthMap | None, look: Look, key: Any, *, new: bool
) -> tuple[Look, Any, UsedPixels | None]:
    return look, key, used_pixels(views, look.view, look.scale, look.ring, depths) if new else None


def _upload(
    passes: fit.FitPasses, views: Views, found: UsedPixels, samples: int, bent: dict[Any, Buffer]
) -> UploadedView | None:
    """Upload the pixels of a view. bent: the directions through each lens that are on the device already."""
    camera = found.camera
    if not len(found.numbers):
        return None
    optics = camera.fx, camera.fy, camera.cx, camera.cy
    eye, turn = camera.pose[:3, 3].copy(), camera.pose[:3, :3].copy()
    made = fit.Pixels(found.numbers, found.targets, eye, turn, optics, camera.width, views.background, found.distances)
    if not camera.bends:
        return passes.upload_view(made)
    key = camera.width, camera.height, optics, camera.lens, samples
    if key not in bent:
        bent[key] = passes.upload_directions(_directions(camera, samples))
    return passes.upload_view(made, bent[key])


def _directions(camera: Camera, samples: int) -> Singles:
    """Return a unit direction in the camera's axes for each ray of each pixel, (H W samples^2, 3)."""
    alone = replace(camera, pose=np.eye(4))
    fine = alone.part(slice(0, camera.width), slice(0, camera.height), finer=samples)
    rays = fine.rays()[1].reshape(camera.height, samples, camera.width, samples, 3).transpose(0, 2, 1, 3, 4)
    return np.ascontiguousarray(rays.reshape(-1, 3), np.float32)
