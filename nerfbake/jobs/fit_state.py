"""State of a running fit: its CPU time, progress and quality on held-out views, and its checkpoints in a folder.

A run that was killed resumes from its last checkpoint and writes the same bytes.
"""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from types import FrameType
from typing import TYPE_CHECKING, Any, NamedTuple, NoReturn

from nerfbake import io
from nerfbake.errors import InvalidFile, MemoryLimit, NerfbakeError, Problem, Stopped
from nerfbake.jobs.files import FolderTarget, Target
from nerfbake.jobs.photographs import SplitViews
from nerfbake.jobs.steps import Steps
from nerfbake.kernels.compile_times import compiling
from nerfbake.scene.schedule import Schedule, Stage
from nerfbake.scene.views import Views

if TYPE_CHECKING:
    from nerfbake.device.gpu import Gpu
    from nerfbake.stages.overlap import Overlap
    from nerfbake.stages.views_to_field import FitState

HANDFUL = 4  # held-out views that are measured during a fit
_PATIENCE = 0.1  # share of the CPU time of the fit that measuring may take


class CurvePoint(NamedTuple):
    """Quality of a fit at the end of an epoch.

    seconds     CPU seconds of work until then, without compiling kernels and without measuring
    psnr        mean over at most HANDFUL of the held-out views, in dB
    stage       number of finished stages; epoch: number of finished epochs of the next stage
    resolution  resolution of the finest lattice; cells: number of its cells
    """

    seconds: float
    psnr: float
    stage: int
    epoch: int
    resolution: int
    cells: int


class Clock:
    """CPU seconds of all threads, and wall-clock seconds, both without pauses and without compiling kernels."""

    def __init__(self, worked: float = 0.0, passed: float = 0.0) -> None:
        self._worked, self._passed = worked - _working(), passed - _passing()

    @property
    def worked(self) -> float:
        return self._worked + _working()

    @property
    def passed(self) -> float:
        return self._passed + _passing()

    @contextmanager
    def paused(self) -> Iterator[None]:
        worked, passed = _working(), _passing()
        try:
            yield
        finally:
            self._worked -= _working() - worked
            self._passed -= _passing() - passed


def _working() -> float:
    return time.process_time() - compiling().worked


def _passing() -> float:
    return time.perf_counter() - compiling().passed


def _cost(stage: Stage) -> float:
    """Return the relative cost of an epoch. It grows more slowly than the number of pixels and of cells."""
    return stage.cells * (1 + stage.rays) / (1 + stage.scale)


class FitRun:
    """Follows the states of a fit, and measures its quality on a few of the held-out views.

    samples: rays along each edge of a pixel with which these are rendered. gpu: the graphics device that does the work,
    if any. overlap: of the training views, if it was measured.
    """

    def __init__(self, split: SplitViews, schedule: Schedule, samples: int, gpu: Gpu | None = None) -> None:
        self.gpu = gpu
        held_out = split.held_out
        self.overlap: Overlap | None = None
        self._names = [camera.name for camera in split.training.cameras.cameras]
        self._views, self._schedule, self._samples = len(split.training.pictures), schedule, samples
        count = len(held_out.pictures)
        self._which = f"{min(count, HANDFUL)} of {count} held-out views"
        self._held_out = held_out.take(range(0, count, max(1, count // HANDFUL))[:HANDFUL])
        self._looked, self._epoch = 0.0, (0, 0)
        self.devices = [self.device]
        self.clock, self.curve = Clock(), list[CurvePoint]()

    @property
    def device(self) -> str:
        """Name of the graphics device that does the work, or cpu."""
        return "cpu" if self.gpu is None else self.gpu.name

    @property
    def shared(self) -> tuple[float | None, float | None, tuple[str, ...]]:
        """The numbers of the overlap, and the names of the views that are alone."""
        if self.overlap is None:
            return None, None, ()
        return self.overlap.share, self.overlap.agreement, tuple(self._names[view] for view in self.overlap.alone)

    def go_on_without_device(self, state: FitState | None) -> str:
        """After an error of the device, let the CPU do the rest; return from where, as text.

        state: the state of the fit, which returns to where it was last read; None: there is none yet.
        """
        self.gpu = None
        self.devices.append(self.device)
        if state is None:
            return "the CPU does all of the fit"
        state.return_to_cpu()
        self._epoch = state.stage, state.epoch
        return f"the CPU goes on from stage {state.stage + 1}, epoch {state.epoch + 1}"

    def goes_on(self, state: FitState, last: Checkpoint) -> None:
        """Resume from the state in the checkpoint of an earlier run."""
        self._epoch = state.stage, state.epoch
        self.clock, self.curve = Clock(last.worked, last.passed), list(last.curve)
        self.devices = list(dict.fromkeys([*last.devices, self.device]))

    def follow(self, state: FitState) -> bool:
        """Return whether an epoch has ended since the last state. If so, measure the quality."""
        epoch = state.stage, state.epoch
        ended, self._epoch = epoch != self._epoch, epoch
        if ended:
            self._look(state)
        return ended

    def _look(self, state: FitState) -> None:
        """Measure the quality, unless measuring has already taken more than its share of the time."""
        worked = self.clock.worked
        if self._looked > _PATIENCE * worked and self.curve:
            return
        before = time.process_time()
        with self.clock.paused():
            psnr = self._seen(state)
        self._looked += time.process_time() - before
        if psnr is not None:
            self.curve.append(CurvePoint(worked, psnr, state.stage, state.epoch, state.resolution, state.cells.n))

    def share(self, state: FitState) -> float:
        """Return the share of the work that is done, 0 to 1."""
        costs = [stage.epochs * _cost(stage) for stage in self._schedule]
        begun = sum(_cost(stage) for stage in self._schedule[state.stage : state.stage + 1])
        return float(sum(costs[: state.stage]) + begun * (state.epoch + state.view / self._views)) / sum(costs)

    def progress_text(self, state: FitState) -> str:
        """Return the progress as text: stage, resolution, voxels and PSNR."""
        seen = f", {self.curve[-1].psnr:.2f} dB on {self._which}" if self.curve else ""
        stage = min(state.stage + 1, len(self._schedule))
        return f"stage {stage} of {len(self._schedule)}, {state.resolution}^3, {state.cells.n:,} voxels{seen}"

    def _seen(self, state: FitState) -> float | None:
        from nerfbake.stages.views_to_field import measure_state  # here, because most jobs use only the clock

        try:
            return measure_state(state, self._held_out, samples=self._samples)
        except MemoryLimit:
            return None  # the fit itself may still fit into memory


_OFTEN = 30.0  # seconds between checkpoints
# Of checkpoints. Increase it when their arrays change, or when a fit starts from other cells: a fit that goes on would
# then differ from one that begins anew.
_VERSION = 5


class Checkpoint(NamedTuple):
    """A checkpoint: its file, its arrays, and the CPU seconds, wall-clock seconds, curve and devices until then."""

    path: str
    arrays: dict[str, Any]
    worked: float
    passed: float
    curve: list[CurvePoint]
    devices: list[str]


class CheckpointWriter:
    """Writes checkpoints of one fit to a folder.

    arguments: everything besides the pictures that the output bytes depend on, as text.
    """

    def __init__(self, folder: str, arguments: Mapping[str, str], views: Views) -> None:
        self._folder = folder
        self._key = {"checkpoint format": str(_VERSION), **arguments, "pictures": _digest(views)}
        self._kept = time.monotonic()

    @property
    def is_due(self) -> bool:
        return time.monotonic() - self._kept > _OFTEN

    def keep(
        self, state: FitState, *, worked: float, passed: float, curve: Sequence[CurvePoint], devices: Sequence[str]
    ) -> None:
        """Replace the last checkpoint atomically. Raises OutputError."""
        facts = {"key": self._key, "worked": worked, "passed": passed, "curve": curve, "devices": devices}
        io.save_checkpoint(self._folder, facts, state.arrays())
        self._kept = time.monotonic()

    def last(self) -> Checkpoint | None:
        """Return the last checkpoint, or None if there is none.

        Raises InvalidFile if the file is not a checkpoint, or belongs to a fit with other arguments or pictures.
        """
        found = io.load_checkpoint(self._folder)
        if found is None:
            return None
        facts, arrays = found
        path = str(io.checkpoint_path(self._folder))
        with io.blame(path):
            self._require_same(facts.get("key"))
            worked, passed = (_number(name, facts.get(name)) for name in ("worked", "passed"))
            curve, devices = _points(facts.get("curve")), _devices(facts.get("devices"))
            return Checkpoint(path, arrays, worked, passed, curve, devices)

    def _require_same(self, key: Any) -> None:
        key = key if isinstance(key, dict) else {}
        for name, value in self._key.items():
            if key.get(name) != value:
                was = str(key.get(name, "nothing"))[:80]
                if name == "pictures":
                    problem = Problem(
                        "the fit", "had other pictures, cameras or points", "the same, or another `state`"
                    )
                else:
                    problem = Problem(
                        f"the fit's {name}", f"was {was}", f"the same as now ({value}), or another `state`"
                    )
                raise InvalidFile(problem)


def _digest(views: Views) -> str:
    """Return a hash of the inputs of a fit: cameras, pixels and background."""
    import hashlib  # here, so that --help does not import it

    found = hashlib.sha256(
        repr((tuple(map(float, views.background)), views.masked, views.scenery, views.rough)).encode()
    )
    for camera, pixels in zip(views.cameras.cameras, views.pictures, strict=True):
        inside = tuple(map(float, (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)))
        found.update(repr((inside, camera.lens, camera.pose.tolist())).encode())
        found.update(pixels.tobytes())
    if (points := views.cameras.points) is not None:  # the first cells are where they are
        for array in (points.positions, points.camera, points.point, points.pixel):
            found.update(array.tobytes())
    return found.hexdigest()


def _number(name: str, value: Any) -> float:
    if not isinstance(value, int | float) or isinstance(value, bool) or not 0 <= value < 1e9:
        raise InvalidFile(Problem(name, f"is {str(value)[:40]}", "a number of seconds"))
    return float(value)


def _devices(names: Any) -> list[str]:
    if not (isinstance(names, list) and names and all(isinstance(name, str) for name in names)):
        raise InvalidFile(Problem("devices", f"is {str(names)[:40]}", "a list of names"))
    return names


def _points(rows: Any) -> list[CurvePoint]:
    size = len(CurvePoint._fields)
    fine = isinstance(rows, list) and all(isinstance(row, list) and len(row) == size for row in rows)
    if not fine or not all(type(value) in (int, float) for row in rows for value in row):
        raise InvalidFile(Problem("curve", "is no list of points", f"{size} numbers each"))
    return [CurvePoint(*row) for row in rows]


def write_partial(
    steps: Steps, target: Target, kind: str, scene: Any, state: str | None = None, **options: Any
) -> NoReturn:
    """Write the current state as target.partial and raise Stopped. state: the folder of the checkpoints."""
    ending = io.format_for(target.path, kind, to=target.to).name
    partial = target._replace(path=f"{target.path}.partial", to=ending, force=True)
    partial.write(steps, scene, **options)
    goes_on = f"; run the same command to resume from {state}" if state else ""
    raise Stopped(f"stopped before the end: {partial.path} has the current state{goes_on}")


def write_partial_folder(steps: Steps, target: FolderTarget, scene: Any) -> NoReturn:
    """Write the current state as the folder target.partial and raise Stopped."""
    partial = target._replace(path=f"{target.path}.partial", force=True)
    partial.write(steps, scene)
    raise Stopped(f"stopped before the end: {partial.path} has the current state")


@contextmanager
def kept_as_partial(steps: Steps, target: Target | FolderTarget, written: io.PendingFile) -> Iterator[None]:
    """Run a block that measures an output. If it fails, the output becomes target.partial: the work took long."""
    try:
        yield
    except (NerfbakeError, MemoryError, KeyboardInterrupt):
        partial = io.keep_partial(written, target.path)
        steps.say(f"{partial}: is complete, but was not measured")
        raise


@contextmanager
def interrupts() -> Iterator[threading.Event]:
    """Catch Ctrl-C: the first one sets the event, the second one raises KeyboardInterrupt.

    The block checks the event where its work is in a consistent state.
    """
    interrupted = threading.Event()
    before = signal.getsignal(signal.SIGINT)
    if threading.current_thread() is not threading.main_thread() or before in (signal.SIG_IGN, None):
        yield interrupted
        return

    def interrupt(number: int, frame: FrameType | None) -> None:
        if interrupted.is_set():
            raise KeyboardInterrupt
        interrupted.set()

    signal.signal(signal.SIGINT, interrupt)
    try:
        yield interrupted
    finally:
        signal.signal(signal.SIGINT, before)
