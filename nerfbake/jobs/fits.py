"""From photographs to a scene: a sparse field that looks like them, written in any format that can hold it."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from types import FrameType
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, NoReturn

import nerfbake
from nerfbake import catalog, io, progress
from nerfbake.errors import InvalidScene, Stopped, UsageError
from nerfbake.jobs.compressions import LEAST_LOSS, coded_size_of
from nerfbake.jobs.files import AnySource, AnyTarget, Source, Target, as_source, as_target
from nerfbake.jobs.fit_course import Course, Point
from nerfbake.jobs.fit_state import Keeper
from nerfbake.jobs.photographs import ALL, Album, read_photographs
from nerfbake.jobs.steps import SILENT, Steps, Tell

if TYPE_CHECKING:
    from nerfbake.scene.schedule import Schedule
    from nerfbake.stages.views_to_error import ViewError

Dtype = Literal["float16", "float32"]
Pixels = Callable[[], "nerfbake.HeldOut"]  # made only for a scene that keeps or uses them
_GRIDS = ("index",)  # all values in one grid: nothing is lost


def _tree(field: nerfbake.BrickField, dtype: Dtype | None, held_out: nerfbake.HeldOut) -> nerfbake.N3Tree:
    """A PlenOctree in this type; None: float16 where it can hold every value. It keeps the pixels for later."""
    if dtype is None:
        from nerfbake.stages._half import LARGEST  # here, since the help loads no arrays

        values = field.values
        fits = not values.size or max(values.max(), -values.min()) <= LARGEST
        dtype = "float16" if fits else "float32"
    return replace(nerfbake.n3tree_of_bricks(field, dtype=dtype), held_out=held_out)


def _compressed(
    field: nerfbake.BrickField, held_out: Pixels, target: Target, tell: Tell, dtype: Dtype | None
) -> nerfbake.QuantisedOctree:
    """As `nerfbake compress` has it without options."""
    octree, coded_size = nerfbake.octree_of_bricks(field), coded_size_of(target)
    options = {**LEAST_LOSS.options, "held_out": held_out()}
    return nerfbake.compress_octree(octree, coded_size=coded_size, tell=tell, **options).quantised


def _held_out(judges: nerfbake.Views, schedule: Schedule) -> nerfbake.HeldOut:
    """Pixels of the photographs that judge, with the rays a pixel that the scene was fitted for."""
    cameras = replace(judges.cameras, samples=schedule[-1].rays)
    photographs = map(judges.photograph, range(len(judges.pictures)))
    return nerfbake.HeldOut.of(cameras, photographs, background=judges.background)


# What a fitted field becomes, by the scene that the ending of a file stands for; longer endings first. A type of values
# is asked for of a PlenOctree alone.
_WAYS: dict[str, Callable[[nerfbake.BrickField, Pixels, Target, Tell, Dtype | None], Any]] = {
    "SparseVoxelOctree": lambda field, *_: nerfbake.octree_of_bricks(field),
    "QuantisedOctree": _compressed,
    "Volume": lambda field, *_: nerfbake.vdb_of_bricks(field, grids=_GRIDS),
    "N3Tree": lambda field, held_out, target, tell, dtype: _tree(field, dtype, held_out()),
}
_OPTIONS = {"N3Tree": {"packing": "deflated"}}  # of its format: as svox writes it
PRESET = "balanced"
FITTED = tuple(_WAYS)


class Recipe(NamedTuple):
    """How a field is fitted.

    preset      fast, balanced or best: a schedule of stages; None: balanced, unless one of the next two is given
    minutes     how long two cores may work, which chooses a schedule
    epochs      a schedule as text, as it is printed, which has a resolution and samples of its own
    resolution  cells along each axis of the lattice, before some of them are split
    samples     rays along each edge of a pixel, as pictures of the field are to be made: 1 or 2
    basis       of the colours: SH1 to SH25
    box         x0, y0, z0, x1, y1, z1 of the world around the object; None: as the pictures tell
    seed        of the order of the views: the same gives the same bytes
    """

    preset: str | None = None
    minutes: float | None = None
    epochs: str | None = None
    resolution: int = 256
    samples: int = 2
    basis: str = "SH9"
    box: tuple[float, float, float, float, float, float] | None = None
    seed: int = 0

    def schedule(self, views: int | None = None) -> Schedule:
        """The stages, for so many views if it is known how many. Raises UsageError for what contradicts itself."""
        given = [name for name in ("preset", "minutes", "epochs") if getattr(self, name) is not None]
        if len(given) > 1:
            names = " and ".join(f"`{name}`" for name in given)
            raise UsageError(f"{names} each choose a schedule; allowed: one of them")
        from nerfbake.scene.schedule import parse_schedule, preset_schedule, schedule_for  # the help loads no arrays

        asked = {"resolution": self.resolution, "samples": self.samples} | ({"views": views} if views else {})
        try:
            if self.epochs is not None:
                return parse_schedule(self.epochs)
            if self.minutes is not None:
                return schedule_for(self.minutes, **asked)
            return preset_schedule(self.preset or PRESET, **asked)
        except InvalidScene as error:
            raise UsageError(error.what) from None

    def told(self, schedule: Schedule) -> dict[str, str]:
        """All that the bytes depend on beside the pictures."""
        rest = {name: str(getattr(self, name)) for name in ("basis", "box", "seed")}
        return {"nerfbake": nerfbake.__version__, "schedule": str(schedule), **rest}


BALANCED = Recipe()


class Fitted(NamedTuple):
    """What was fitted, as the written file shows it.

    path      of the file, and its content in words, and its bytes
    schedule  as --epochs takes it
    views     how near the file comes to each of the photographs that judge it
    worked    CPU seconds, without compiling kernels and without judging; passed: the same as time
    curve     how near it had come meanwhile
    """

    path: str
    content: str
    bytes: int
    schedule: str
    views: tuple[ViewError, ...]
    worked: float
    passed: float
    curve: tuple[Point, ...]

    @property
    def psnr(self) -> float:
        """dB, the mean over the views."""
        return sum(view.psnr for view in self.views) / len(self.views)

    @property
    def ssim(self) -> float:
        """The mean over the views."""
        return sum(view.ssim for view in self.views) / len(self.views)


def fit_scene(
    source: AnySource,
    *,
    album: Album = ALL,
    recipe: Recipe = BALANCED,
    dtype: Dtype | None = None,
    steps: Steps = SILENT,
) -> nerfbake.N3Tree:
    """The PlenOctree that fit_file() would write as .npz, without a file and without judging it.

    The views that fit_file() keeps for judging are kept here, too, so that the scene is the same. Raises NerfbakeError.

    >>> tree = fit_scene("photographs", recipe=Recipe(preset="fast", resolution=32, basis="SH1"))
    >>> tree.data_format
    'SH1'
    """
    source = as_source(source)
    album.require()
    recipe.schedule()
    posed = read_photographs(steps, source, album)
    schedule = recipe.schedule(len(posed.trained.pictures))
    field = _fit(steps, source, posed.trained, schedule, recipe, Course(posed, schedule), None, [])
    with steps.phase("putting the field together"):
        return _tree(field, dtype, _held_out(posed.judges, schedule))


def fit_file(
    source: AnySource,
    target: AnyTarget,
    *,
    album: Album = ALL,
    recipe: Recipe = BALANCED,
    dtype: Dtype | None = None,
    state: str | None = None,
    steps: Steps = SILENT,
    report: Callable[[Fitted], None] | None = None,
) -> Fitted:
    """Fits a sparse field to the photographs of a capture, and gives what its file shows; `nerfbake fit` is this.

    Reads the cameras and pictures of `source` and of `album`; writes `target`, whose ending says as what, and keeps
    checkpoints in the folder `state`. A run that was killed goes on from there, to the same bytes. Ctrl-C writes what
    there is as `target`.partial and raises Stopped, exit code 130. report gets what is returned. Raises NerfbakeError.

    dtype: of a PlenOctree's values; None: float16, or float32 where a value is too large for float16.

    >>> fitted = fit_file("photographs", "fitted.npz", recipe=Recipe(preset="fast", resolution=32, basis="SH1"))
    >>> fitted.psnr > 15
    True
    """
    source, target = as_source(source), as_target(target)
    album.require()
    recipe.schedule()  # what contradicts itself is told before any picture is read
    kind = _require(target)
    if dtype is not None and kind != "N3Tree":
        raise UsageError(f"`dtype` has no effect on {target.path}; allowed: with a PlenOctree")
    if state is not None:
        io.require_checkpoints(state)
    posed = read_photographs(steps, source, album)
    judges, schedule = posed.judges, recipe.schedule(len(posed.trained.pictures))
    steps.say(f"{source.name}: {posed.trained} to fit to, {judges} to judge by")
    steps.say(f"{source.name}: `epochs={schedule}`")
    keeper = None if state is None else Keeper(state, recipe.told(schedule), posed.trained)
    course = Course(posed, schedule)
    with _interrupts() as asked:
        field = _fit(steps, source, posed.trained, schedule, recipe, course, keeper, asked)
        with steps.phase("putting the field together") as tell, io.blame(target.path):
            scene = _WAYS[kind](field, lambda: _held_out(judges, schedule), target, tell, dtype)
        del field, posed
        if asked:
            _write_partial(steps, target, kind, scene, state)
        target.write(steps, scene, **_OPTIONS.get(kind, {}))
    if asked:
        raise Stopped(f"stopped before it was judged: {target.path} is whole")
    del scene
    fitted = _judged(steps, target, judges, schedule, course)
    if report is not None:
        report(fitted)
    return fitted


def _require(target: Target) -> str:
    """The type of scene that the target holds. Raises, before any work is done, if no field can be written there."""
    if target.path == io.STREAM:
        raise UsageError("fit judges the file that it wrote; allowed: an OUT other than '-'")
    ending = target.path if target.to is None else f".{target.to.removeprefix('.')}"
    kind = next((kind for kind in _WAYS if catalog.is_ending(ending, kind)), None)
    if kind is None:
        endings = ", ".join(form.suffix for kind in _WAYS for form in catalog.formats_of(kind))
        raise UsageError(f"{ending!r} names nothing that a field is written as; allowed: {endings}, or `to=FORMAT`")
    form = target.require(kind)
    if kind == "Volume":
        form.load_volume_module().require_grids(_GRIDS, half=False)
    return kind


def _fit(
    steps: Steps,
    source: Source,
    views: nerfbake.Views,
    schedule: Schedule,
    recipe: Recipe,
    course: Course,
    keeper: Keeper | None,
    asked: list[int],
) -> nerfbake.BrickField:
    """What was fitted until the end, or until somebody asked for it."""
    from nerfbake.scene.views import world_box
    from nerfbake.stages.views_to_field import fit_field

    now = start = _start(keeper, course)
    with steps.phase("fitting"), io.blame(source.name):
        box = None if recipe.box is None else world_box(recipe.box)
        for now in fit_field(views, schedule=schedule, basis=recipe.basis, box=box, seed=recipe.seed, start=start):
            with progress.listening(None):  # what judges a stage has no share of its own
                ended = course.follow(now)
            if keeper is not None and (ended or asked or keeper.is_due):
                _keep(keeper, now, course)
            progress.report(course.share(now), course.told(now))
            if asked:
                break
        field: nerfbake.BrickField = now.field()
        return field


def _start(keeper: Keeper | None, course: Course) -> Any:
    """Where an earlier run was stopped; None where there was none."""
    last = None if keeper is None else keeper.last()
    if last is None:
        return None
    from nerfbake.stages.views_to_field import FitState

    with io.blame(last.path):
        now = FitState.of_arrays(last.arrays)
    course.goes_on(now, worked=last.worked, curve=last.curve)
    return now


def _keep(keeper: Keeper, now: Any, course: Course) -> None:
    worked = course.clock.worked
    with course.clock.paused():
        keeper.keep(now, worked=worked, curve=course.curve)


def _write_partial(steps: Steps, target: Target, kind: str, scene: Any, state: str | None) -> NoReturn:
    """Writes what there is beside where it should have been, and raises Stopped."""
    ending = io.format_for(target.path, kind, to=target.to).name
    partial = target._replace(path=f"{target.path}.partial", to=ending, force=True)
    partial.write(steps, scene, **_OPTIONS.get(kind, {}))
    goes_on = f"; the same command goes on from {state}" if state else ""
    raise Stopped(f"stopped before it was done: {partial.path} has what there was{goes_on}")


def _judged(steps: Steps, target: Target, judges: nerfbake.Views, schedule: Schedule, course: Course) -> Fitted:
    """What the file shows, read as anybody would read it, with the rays a pixel that it was fitted for."""
    worked, passed, samples = course.clock.worked, course.clock.passed, schedule[-1].rays
    file = Source(target.path)
    with file.blamed(steps, f"judging by {len(judges.pictures)} pictures"):
        loaded = file.read_with_format(steps)
        views = nerfbake.measure_views(nerfbake.build_field(loaded.scene), judges, samples=samples)
    told = str(loaded.scene)
    fitted = Fitted(target.path, told, loaded.size, str(schedule), views, worked, passed, tuple(course.curve))
    seen = (
        f"{fitted.psnr:.2f} dB, SSIM {fitted.ssim:.4f} on {judges}{replace(judges.cameras, samples=samples).rays_told}"
    )
    steps.say(f"{target.path}: {seen}; after {worked:.0f} CPU seconds, {passed:.0f} seconds")
    return fitted


@contextmanager
def _interrupts() -> Iterator[list[int]]:
    """What Ctrl-C asks for, once, so that work can end where it is whole; the second time it ends at once.

    The list is empty until then.
    """
    asked: list[int] = []
    before = signal.getsignal(signal.SIGINT)
    if threading.current_thread() is not threading.main_thread() or before in (signal.SIG_IGN, None):
        yield asked
        return

    def ask(number: int, frame: FrameType | None) -> None:
        if asked:
            raise KeyboardInterrupt
        asked.append(number)

    signal.signal(signal.SIGINT, ask)
    try:
        yield asked
    finally:
        signal.signal(signal.SIGINT, before)
