"""A fit on a graphics device: the cells of a stage and the pixels of its views in buffers, and visits of the views.

The passes are shaders/fit/*.wgsl; they do what kernels.fit.rays.march_view(), kernels.fit.update.take_steps() and
kernels.fit.ties do. Sums are integers, so one device and driver gives the same bytes on every run. They are not those
of the CPU, because devices round divisions and exponentials differently.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from math import floor, inf, log2
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake.device.gpu import Bound, Buffer, Dispatch, Download, Gpu, Pipeline
from nerfbake.device.shader_files import read_wgsl
from nerfbake.errors import DeviceError, Problem
from nerfbake.kernels.arrays import Floats, Singles
from nerfbake.kernels.fit.bricks import BrickGrid
from nerfbake.kernels.fit.rays import SUMS
from nerfbake.kernels.fit.ties import Ties
from nerfbake.kernels.fit.update import CORNER_RATE, LearningRates
from nerfbake.kernels.parallel import over_chunks

_VIEW = np.dtype(  # the record `View` of view.wgsl
    [
        ("optics", "f4", 4),
        ("turn", "f4", (3, 4)),
        ("background", "f4", 4),
        ("gains", "f4", 4),
        ("losses", "f4", 4),
        ("limits", "f4", 4),
        ("rates", "f4", 4),
        ("parts", "f4", 8),
        ("ridge", "f4", 8),
        ("counts", "u4", 7),
        ("tilt", "f4"),
        ("shells", "f4", (8, 2, 4)),
        ("tie", "f4"),
        ("tie_edge", "f4"),
        ("coefficient", "u4"),
        ("depth", "f4"),
    ]
)
_RECORDS = 64  # views of one call, which is as many as the buffer of records has
_FRESH, _BENT, _COUNTED = 1, 2, 4
_SLOT = 16  # words of a view's totals
_STEPS = float(1 << 20)  # of a unit, in the totals and at most in the sums of cells
_FEWEST_STEPS = float(1 << 12)
_RANGE = float(1 << 30)
_SUM_OF_RAY = 2.0  # a ray adds about this to a sum of a cell, or less
_GROUP = 64  # threads
_TOGETHER = 1 << 18  # numbers that a core copies or looks at
_PER_SUBMIT = 0.25  # seconds: drivers stop work that takes longer than one or two
_PER_CALL = 1.5  # seconds: Ctrl-C and the progress wait as long
_HARMONICS = "wgsl/harmonics"


class Pixels(NamedTuple):
    """The pixels of a view that are fitted, with its camera.

    numbers (m,): in the picture, in an order in which neighbours are close. targets (m, 4): colour over the background
    (3,), and alpha. eye (3,), turn (3, 3): the axes of the camera in the world, as columns. optics: fx, fy, cx, cy.
    width: of the picture. distances (m,): of the surface that each pixel shows, 0 if it is not known; or (0,).
    """

    numbers: npt.NDArray[np.int32]
    targets: Singles
    eye: Floats
    turn: Floats
    optics: tuple[float, float, float, float]
    width: int
    background: tuple[float, float, float]
    distances: Singles


class Losses(NamedTuple):
    """Weights of the losses, and the largest residuals that count in full: see kernels.fit.rays.FitView."""

    focus: float
    point: float = 0.0
    distortion: float = 0.0
    most: float = inf
    most_mean: float = inf
    alpha: float = 0.0
    depth: float = 0.0


class UploadedView(NamedTuple):
    """The pixels of a view on the device. pixels, bent: see rays.wgsl. tilt: see pinhole_directions()."""

    camera: Pixels
    size: int
    pixels: Buffer
    bent: Buffer | None
    tilt: float = 0.0


class DeviceVisit(NamedTuple):
    """One visit of a view. gains (3,). steps None: the view is only rendered. fresh: clear the blame before."""

    view: UploadedView
    samples: int
    losses: Losses
    gains: Floats
    steps: LearningRates | None
    fresh: bool = False


class _Cells(NamedTuple):
    """The cells of a stage on the device. parts: the values of a range of bricks, with their first and last number."""

    bricks: BrickGrid
    B: int
    near: npt.NDArray[np.float64]
    buffers: dict[str, Buffer]
    parts: list[tuple[int, int, dict[str, Buffer]]]
    pipelines: dict[str, Pipeline]


class FitPasses:
    """A fit on a device. Raises DeviceError; the CPU's arrays are then those of the last upload() or read_back()."""

    def __init__(self, gpu: Gpu) -> None:
        self.gpu = gpu
        self._records = gpu.upload_records(np.zeros(_RECORDS, _VIEW).view(np.uint8).reshape(_RECORDS, -1))
        self._totals = gpu.empty(4 * _SLOT * _RECORDS, "sums of the views")
        self._rays, self._residuals, self._nothing = gpu.empty(16), gpu.empty(16), gpu.empty(16)
        self._cells: _Cells | None = None
        self._bound: dict[Any, Bound] = {}
        self._groups: dict[Any, Any] = {}  # of buffers, which views and passes share
        self._units: dict[Any, float] = {}
        self._pending: list[tuple[Download, float, int]] = []
        self._settled = 0.0  # when the last work ended
        self._seconds = inf  # of a visit

    # -- the cells of a stage ------------------------------------------------------------------------------------
    def upload(self, bricks: BrickGrid, means: Singles, seen: Singles) -> None:
        """Copy the cells to the device."""
        gpu, n, r = self.gpu, len(means), bricks.top.shape[1]
        B = (len(bricks.values) // n - 1) // 3
        self._forget()
        rows = np.zeros((len(bricks.first), 2), np.uint32)
        rows[:, 0] = bricks.first
        at = np.argwhere(bricks.top >= 0)
        rows[:-1, 1] = at[:, 0] // r << 24 | at[:, 0] % r << 16 | at[:, 1] << 8 | at[:, 2]
        places = np.zeros(-(-n // 2) * 2, np.int16)
        places[:n] = bricks.places
        buffers = {
            "bricks": gpu.upload(rows, "the bricks"),
            "places": gpu.upload(places, "the cells"),
            "top": gpu.upload(bricks.top, "the grid of bricks"),
            "slots": gpu.upload(bricks.slots, "the tables of the bricks"),
            "painted": gpu.empty(16 * n, f"the colours of {n:,} cells"),
            "sums": gpu.empty(32 * n, f"the sums of {n:,} cells"),
            "means": gpu.upload(means, "the means of the cells"),
            "seen": gpu.upload(seen, "the weights of the cells"),
        }
        corners = bricks.corners
        if bricks.smooth:
            made = np.zeros((len(corners.raw), 4), np.float32)
            made[:, 0], made[:, 1] = corners.raw, corners.mean
            of_cell = corners.of_cell + np.repeat(corners.first[:-1], np.diff(bricks.first))[:, None]
            buffers["corners"] = gpu.upload(made, "the corners of the cells")
            buffers["cornersOf"] = gpu.upload(corners.entries[of_cell], "the corners of the cells")
        else:
            buffers["corners"], buffers["cornersOf"] = gpu.empty(16), self._nothing
        parts = []
        for begin, end in self._ranges(bricks, 3 * B + 1):
            low, high = int(bricks.first[begin]), int(bricks.first[end])
            own = bricks.values[(3 * B + 1) * low : (3 * B + 1) * high]
            held = {
                "part": gpu.upload(np.array([begin, end, low, 0], np.uint32)),
                "values": gpu.upload(own, f"the values of {high - low:,} cells"),
            }
            parts.append((begin, end, held))
        pipelines = self._compiled(B, bricks.smooth)
        self._cells = _Cells(bricks, B, _centres(bricks, at, r), buffers, parts, pipelines)

    def _compiled(self, B: int, smooth: bool) -> dict[str, Pipeline]:
        """Return the passes for a number of coefficients."""
        found = {}
        for name, (entry, parts, constants) in _shaders(smooth).items():
            head = f"const B = {B};\n" if _HARMONICS in parts else ""
            found[name] = self.gpu.pipeline(head + read_wgsl(*parts), entry, constants)
        return found

    def read_back(self, bricks: BrickGrid, means: Singles, seen: Singles) -> None:
        """Copy values and statistics from the device into the arrays of upload()."""
        cells = self._held()
        self._settle()
        gpu, buffers, D = self.gpu, cells.buffers, 3 * cells.B + 1
        readings = [
            gpu.read_later(own["values"], np.float32, D * int(bricks.first[end] - bricks.first[begin]))
            for begin, end, own in cells.parts
        ]
        others = [gpu.read_later(buffers[name], np.float32, means.size) for name in ("means", "seen")]
        if bricks.smooth:
            others.append(gpu.read_later(buffers["corners"], np.float32, 4 * len(bricks.corners.raw)))
        with ExitStack() as mapped:
            found, more = ([mapped.enter_context(each.mapped()) for each in some] for some in (readings, others))
            for array in found + more[:2]:
                self._require_numbers(array)
            for (begin, _, _), array in zip(cells.parts, found, strict=True):
                _copy(array, bricks.values[D * int(bricks.first[begin]) :])
            for array, out in zip(more, (means, seen), strict=False):
                _copy(array, out.reshape(-1))
            if bricks.smooth:
                corners = more[2].reshape(-1, 4)
                bricks.corners.raw[:], bricks.corners.mean[:] = corners[:, 0], corners[:, 1]

    def tie(self, ties: Ties) -> None:
        """Pull the values of the cells once towards those of their neighbours; interpolated densities stay.

        Returns when the device has done the work.
        """
        cells = self._held()
        tied = [] if ties.coefficients is None else [*enumerate(map(float, ties.coefficients))]
        if not cells.bricks.smooth:
            tied.append((cells.B, ties.density))
        records = np.zeros(len(tied), _VIEW)
        records["counts"][:, 4], records["tie_edge"] = cells.bricks.top.shape[1], ties.edge
        for record, (coefficient, strength) in zip(records, tied, strict=True):
            record["coefficient"], record["tie"] = coefficient, strength
        self._settle()  # so that the time of the ties is not that of a visit
        self._write_records(records)
        for slot in range(len(tied)):
            self.gpu.submit(
                [
                    Dispatch(self._of_part(name, number), end - begin, slot)
                    for name in ("gather", "tie")
                    for number, (begin, end, _) in enumerate(cells.parts)
                ]
            )
            self.gpu.finish()

    def _require_numbers(self, array: npt.NDArray[Any]) -> None:
        def look(begin: int, end: int) -> None:
            if not np.isfinite(array[begin:end]).all():
                raise DeviceError(f"{self.gpu.name}: the values are not numbers")

        over_chunks(look, len(array), _TOGETHER)

    # -- views ---------------------------------------------------------------------------------------------------
    def upload_directions(self, directions: Singles) -> Buffer:
        """Copy a unit direction (., 3) in the camera's axes for each ray of a whole picture, if a lens bends them."""
        return self.gpu.upload(directions, "the directions of the rays")

    def upload_view(self, pixels: Pixels, bent: Buffer | None = None) -> UploadedView:
        """Copy the pixels of a view to the device. bent: from upload_directions(), or None for a pinhole."""
        words = np.zeros((len(pixels.numbers), 4), np.uint32)
        words[:, 0] = pixels.numbers
        words[:, 1:3] = np.rint(pixels.targets * np.float32(65535)).astype(np.uint16).view(np.uint32)
        if len(pixels.distances):
            words[:, 3] = pixels.distances.view(np.uint32)
        camera = pixels._replace(numbers=pixels.numbers[:0], targets=pixels.targets[:0], distances=pixels.distances[:0])
        return UploadedView(camera, len(words), self.gpu.upload(words, f"the {len(words):,} pixels of a view"), bent)

    def size(self) -> int:
        """Return the number of visits that one call of visit() should make: about a second of work."""
        return int(min(max(_PER_CALL / self._seconds, 1), _RECORDS))

    def visit(self, visits: Sequence[DeviceVisit], *, counted: bool = False) -> Floats:
        """DeviceVisit views one after the other. Returns the sums (visits, SUMS) of march_view(); zeros unless counted.

        Returns before the device has done the work, unless counted.
        """
        sums, first = np.zeros((len(visits), SUMS)), 0
        self._reserve(visits)
        while first < len(visits):
            some = visits[first : first + self.size()]
            self._start(some, counted)
            if counted or first + len(some) < len(visits):
                sums[first : first + len(some)] = self._settle()
            first += len(some)
        return sums

    def _start(self, visits: Sequence[DeviceVisit], counted: bool) -> None:
        """Submit the work of some visits."""
        cells, gpu = self._held(), self.gpu
        records = np.zeros(len(visits), _VIEW)
        for slot, visit in enumerate(visits):
            records[slot] = self._record(cells, visit, slot, counted)
        started = time.perf_counter()
        self._write_records(records)
        gpu.write(self._totals, np.zeros(_SLOT * len(visits), np.uint32))
        work: list[Dispatch] = []
        for slot, visit in enumerate(visits):
            work += self._dispatches(cells, visit, slot)
            if (slot + 1) % max(int(_PER_SUBMIT / self._seconds), 1) == 0 or slot + 1 == len(visits):
                gpu.submit(work)
                work = []
        self._pending.append((gpu.read_later(self._totals, np.uint32, _SLOT * len(visits)), started, len(visits)))
        self._settle(running=1)  # the device has this work while the next is prepared

    def _write_records(self, records: npt.NDArray[Any]) -> None:
        padded = np.zeros((len(records), self._records.stride), np.uint8)
        padded[:, : _VIEW.itemsize] = records.view(np.uint8).reshape(len(records), _VIEW.itemsize)
        self.gpu.write(self._records, padded)

    def _settle(self, *, running: int = 0) -> Floats:
        """Wait for what was started, but for the last `running` calls; return the sums (visits, SUMS) of the last."""
        sums = np.zeros((0, SUMS))
        while len(self._pending) > running:
            reading, started, count = self._pending.pop(0)
            words = reading.take().reshape(count, _SLOT)
            now = time.perf_counter()
            self._seconds, self._settled = (now - max(started, self._settled)) / count, now
            if words[:, _SLOT - 1].any():
                raise DeviceError(f"{self.gpu.name}: a sum of a cell is out of range")
            low, high = words[:, : 2 * SUMS : 2].astype(np.float64), words[:, 1 : 2 * SUMS : 2].astype(np.float64)
            sums = (low + high * 2.0**32) / _STEPS
        return sums

    def _record(self, cells: _Cells, visit: DeviceVisit, slot: int, counted: bool) -> Any:
        view, losses, steps = visit.view.camera, visit.losses, visit.steps
        record = np.zeros((), _VIEW)
        record["optics"], record["turn"][:, :3] = view.optics, view.turn
        record["background"][:3], record["gains"][:3] = view.background, visit.gains
        record["losses"] = losses.alpha, losses.point, losses.distortion, losses.focus
        record["depth"] = losses.depth
        unit = _STEPS
        if steps is not None:
            key = visit.view.pixels, visit.samples
            unit = self._units.get(key) or self._units.setdefault(key, self._steps_a_unit(cells, visit))
        record["limits"] = min(losses.most, 1e30), min(losses.most_mean, 1e30), unit, 1 / unit
        if steps is not None:
            density, colour, rays = steps.density, steps.colour, steps.rays
            record["rates"] = density, colour, CORNER_RATE * density, 1 / rays
            for name, values in ("parts", steps.parts), ("ridge", steps.ridge):
                firsts = [k * k for k in range(5) if k * k < len(values)]
                record[name][: len(firsts)] = values[firsts]
        flags = _FRESH * visit.fresh | _BENT * (visit.view.bent is not None) | _COUNTED * counted
        bricks = cells.bricks
        r, shells = bricks.top.shape[1], len(bricks.low)
        record["counts"] = visit.view.size, view.width, visit.samples, flags, r, shells, slot
        record["tilt"] = visit.view.tilt
        record["shells"][:shells, 0, :3] = (view.eye - bricks.low) / bricks.size
        record["shells"][:shells, 1, :3], record["shells"][:shells, 1, 3] = bricks.size, bricks.width
        return record

    def _steps_a_unit(self, cells: _Cells, visit: DeviceVisit) -> float:
        """Return how fine the sums are: the more rays meet one cell, the coarser, so that no sum leaves its range."""
        bricks, view = cells.bricks, visit.view.camera
        away = np.sqrt(np.square(cells.near[:, :3] - view.eye).sum(axis=1))
        cell = cells.near[:, 3]  # the diagonal
        nearest = away - 9 * cell / 2  # of any cell that a brick may have
        close = nearest < 4 * cell
        angle = float((cell / np.maximum(nearest, 1e-30))[~close].max(initial=0.0))
        for brick in np.flatnonzero(close):
            angle = max(angle, _nearest_angle(bricks, cells.near[brick], int(brick), view.eye))
        rays = visit.samples**2
        # Towards the corners of a picture, a cell covers more pixels.
        most = min(4 * (max(view.optics[:2]) * angle) ** 2 * rays, float(max(visit.view.size, 1) * rays))
        unit = min(_STEPS, 2.0 ** floor(log2(_RANGE / (_SUM_OF_RAY * max(most, 1)))))
        if unit < _FEWEST_STEPS:
            allowed = f"{int(_RANGE / _SUM_OF_RAY / _FEWEST_STEPS):,} on a graphics device"
            raise DeviceError(Problem("a cell", f"may meet {int(most):,} rays of a view", allowed))
        return unit

    def _reserve(self, visits: Sequence[DeviceVisit]) -> None:
        """Make the buffers of rays and pixels large enough."""
        pixels = max(visit.view.size for visit in visits)
        rays = max(visit.view.size * visit.samples**2 * (2 if visit.losses.distortion else 1) for visit in visits)
        if 16 * rays > self._rays.size or 16 * pixels > self._residuals.size:
            self._settle()
            self._unbind()
            largest = self.gpu.limits.binding
            self._rays = self.gpu.empty(max(16 * rays, min(20 * rays, largest)), f"{rays:,} rays of a view")
            self._residuals = self.gpu.empty(max(16 * pixels, min(20 * pixels, largest)), f"{pixels:,} pixels")

    def _dispatches(self, cells: _Cells, visit: DeviceVisit, slot: int) -> Iterator[Dispatch]:
        pixels = visit.view.size
        rays = -(-pixels * visit.samples**2 // _GROUP)
        for number, (begin, end, _) in enumerate(cells.parts):
            yield Dispatch(self._of_part("paint", number), end - begin, slot)
        yield Dispatch(self._of_view("march", visit.view), rays, slot)
        yield Dispatch(self._of_view("residual", visit.view), -(-pixels // _GROUP), slot)
        if visit.steps is None:
            return
        yield Dispatch(self._of_view("back", visit.view), rays, slot)
        for number, (begin, end, _) in enumerate(cells.parts):
            yield Dispatch(self._of_part("step", number), end - begin, slot)
        if cells.bricks.smooth:
            yield Dispatch(self._of_part("stepCorners", 0), -(-len(cells.bricks.corners.raw) // _GROUP), slot)

    def _of_part(self, name: str, part: int) -> Bound:
        own = self._held().parts[part][2]
        return self._with(name, own["values"], own)

    def _of_view(self, name: str, view: UploadedView) -> Bound:
        return self._with(name, view.pixels, {"pixels": view.pixels, "bent": view.bent or self._nothing})

    def _with(self, name: str, key: Buffer, own: dict[str, Buffer]) -> Bound:
        if (name, key) not in self._bound:
            cells = self._held()
            shared = {"view": self._records, "totals": self._totals, "rays": self._rays, "residuals": self._residuals}
            buffers = {**cells.buffers, **shared, **own}
            self._bound[name, key] = self.gpu.bind(cells.pipelines[name], buffers, self._groups)
        return self._bound[name, key]

    def _held(self) -> _Cells:
        assert self._cells is not None, "upload() comes first"
        return self._cells

    def _forget(self) -> None:
        """Free the cells of the stage before."""
        self._settle()
        self._unbind()
        self._units.clear()
        self._cells = None

    def _unbind(self) -> None:
        self._bound.clear()
        self._groups.clear()

    def _ranges(self, bricks: BrickGrid, D: int) -> Iterator[tuple[int, int]]:
        """Yield the first and the last brick of parts whose values fit into a binding."""
        most, begin = self.gpu.limits.binding // (4 * D), 0
        while begin < len(bricks.slots):
            end = int(np.searchsorted(bricks.first, bricks.first[begin] + most, side="right")) - 1
            yield begin, max(end, begin + 1)
            begin = max(end, begin + 1)


def _copy(array: npt.NDArray[Any], out: npt.NDArray[Any]) -> None:
    """Copy an array (n,) to the begin of another one, on all cores."""

    def copy(begin: int, end: int) -> None:
        out[begin:end] = array[begin:end]

    over_chunks(copy, len(array), _TOGETHER)


def _centres(bricks: BrickGrid, at: Any, r: int) -> npt.NDArray[np.float64]:
    """Return the centre of each brick in the world, and the diagonal of its cells: (b, 4)."""
    shell = at[:, 0] // r
    found = np.empty((len(at), 4))
    found[:, :3] = bricks.low[shell] + (8 * (at - [1, 0, 0] * (shell * r)[:, None]) + 4) * bricks.size[shell]
    found[:, 3] = 2 * np.sqrt(np.square(bricks.size).sum(axis=1))[shell]  # wide cells
    return found


def _nearest_angle(bricks: BrickGrid, near: npt.NDArray[np.float64], brick: int, eye: Floats) -> float:
    """Return the largest size of a brick's cells, over their distance from a camera that is close."""
    places = bricks.places[bricks.first[brick] : bricks.first[brick + 1]]
    size = near[3] / 2
    edge = size / np.sqrt(3.0)
    within = np.stack([places >> 7, places >> 4 & 7, places >> 1 & 7], axis=1) - 3.5
    diagonal = size * (1 + (places & 1))
    away = np.sqrt(np.square(near[:3] + within * edge - eye).sum(axis=1)) - diagonal
    return float((diagonal / np.maximum(away, 1e-30)).max())


def _shaders(smooth: bool) -> dict[str, tuple[str, tuple[str, ...], dict[str, float]]]:
    """Return entry point, parts of the text and constants of each pass."""
    kind = {"smoothed": float(smooth)}
    of_cells, of_rays = (_HARMONICS, "fit/view", "fit/cells"), ("fit/view", "fit/rays")
    ties, walk = (*of_cells, "fit/grid", "fit/tie"), (*of_rays, "fit/grid", "fit/march")
    return {
        "paint": ("paint", (*of_cells, "fit/paint"), {}),
        "march": ("march", walk, kind),
        "residual": ("residual", (*of_rays, "fit/residual"), {}),
        "back": ("march", walk, {"back": 1.0, **kind}),
        "step": ("stepCells", (*of_cells, "fit/step"), kind),
        "gather": ("gather", ties, {}),
        "tie": ("tie", ties, {}),
        "stepCorners": ("stepCorners", ("fit/view", "fit/corners"), {}),
    }
