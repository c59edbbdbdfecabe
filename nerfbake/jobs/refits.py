"""Fit the values of an octree to a finer scene or to photographs, without adding nodes."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, NamedTuple

from nerfbake import io, progress
from nerfbake.device.adapters import open_device
from nerfbake.errors import DeviceError, UsageError
from nerfbake.jobs.budgets import EDGE
from nerfbake.jobs.devices import DEVICE, renderer_with
from nerfbake.jobs.files import AnySource, AnyTarget, Source, Target, as_source, as_target, read_back_as
from nerfbake.jobs.fit_state import Clock
from nerfbake.jobs.photographs import PhotographOptions, SplitViews, mean_of, read_photographs, render_split
from nerfbake.jobs.readings import Reading
from nerfbake.jobs.steps import SILENT, Steps
from nerfbake.kernels.arrays import Points
from nerfbake.scene.brick_field import BrickField
from nerfbake.scene.n3tree import N3Tree
from nerfbake.scene.splats import Splats
from nerfbake.stages.brick_field_to_octree import fill_octree
from nerfbake.stages.octree_to_brick_field import build_bricks
from nerfbake.stages.renderers import Renderer
from nerfbake.stages.scene_to_field import build_field
from nerfbake.stages.views_to_error import ViewError, measure_views

if TYPE_CHECKING:
    from nerfbake.device.gpu import Gpu

_ALL = 0.75  # of the width of a scene with scenery; its inner cube has half of it or less


@dataclass(frozen=True, kw_only=True)
class RefitReference:
    """What an octree is fitted to: a finer scene or photographs.

    like         a PlenOctree, an octree, a volume, a lattice or splats, rendered from all sides
    frames       number of these pictures; edge: their width and height in pixels
    views        a capture
    photographs  options for the photographs of the capture
    """

    like: str | None = None
    views: str | None = None
    frames: int = 100
    edge: int = EDGE
    photographs: PhotographOptions = PhotographOptions()

    def require(self) -> None:
        """Raise UsageError unless exactly one of like and views is given. Call it before doing any work."""
        if (self.like is None) == (self.views is None):
            given = "both are given" if self.like else "neither is given"
            raise UsageError(f"`like` and `views`: {given}; allowed: one of them, which IN is fitted to")
        self.photographs.require()

    def split(self, steps: Steps, samples: int, box: Points, render: Renderer) -> SplitViews:
        """Return the training views and the held-out views.

        samples: rays along each edge of a pixel. box: the octree's; if it is not as wide as a scene with scenery, the
        pictures show the inner cube. render: renders fields.
        """
        if self.views is not None:
            return read_photographs(steps, Source(self.views), replace(self.photographs, scenery="drop"))
        bigger = Source(str(self.like))
        reading = Reading(steps, bigger)
        if isinstance(reading.scene, N3Tree) and ((box[1] - box[0]) * reading.scene.invradius < _ALL).all():
            reading.use_inner_cube()
        shown = reading.scene if isinstance(reading.scene, Splats) else reading.field()
        with bigger.blamed(steps, f"rendering pictures of {bigger.name}"):
            return render_split(shown, frames=self.frames, edge=self.edge, samples=samples, render=render)


@dataclass(frozen=True, kw_only=True)
class RefitOptions:
    """Options of a refit.

    epochs   number of passes over the pictures
    samples  rays along each edge of a pixel, 1 or 2: choose the value that the octree will be rendered with
    seed     seed for the order of the pictures: the same seed gives the same bytes
    """

    epochs: int = 2
    samples: int = 2
    seed: int = 0


class RefitResult(NamedTuple):
    """The result of a refit, measured on the written file.

    path    path of the file; content: description of its contents; bytes: its size
    before  error of IN on each of the held-out views; after: error of the file
    worked  CPU seconds, without compiling kernels, rendering pictures and measuring
    """

    path: str
    content: str
    bytes: int
    before: tuple[ViewError, ...]
    after: tuple[ViewError, ...]
    worked: float

    @property
    def psnr(self) -> tuple[float, float]:
        """Mean PSNR over the views in dB, before and after."""
        return mean_of(self.before, "psnr"), mean_of(self.after, "psnr")


def refit_file(
    source: AnySource,
    target: AnyTarget,
    reference: RefitReference,
    *,
    options: RefitOptions = RefitOptions(),
    no_child: int | None = None,
    device: str = DEVICE,
    steps: Steps = SILENT,
) -> RefitResult:
    """Fit the leaf values of an octree to a finer scene or to photographs. This is `nerfbake refit`.

    Reads `source`, which becomes an octree as in bake_octree(), and the files of `reference`. Writes the octree
    `target`, which has the same nodes. Returns the quality before and after. Raises NerfbakeError.

    no_child  child index that means 'no child' in the file, 0 or -1; None: the default of the format

    >>> refitted = refit_file("octree.svo.npz", "refitted.svo.npz", RefitReference(like="a.npz", frames=8, edge=64))
    >>> refitted.psnr[1] > 20
    True
    """
    source, target = as_source(source), as_target(target)
    reference.require()
    _require(target, no_child)
    gpu = open_device(device)
    render = renderer_with(steps, gpu)
    octree = Reading(steps, source).octree()
    with source.blamed(steps, "preparing"):
        cells = build_bricks(octree)
    split = reference.split(steps, options.samples, cells.box, render)
    before = _measure(steps, source, octree, split, options, render)
    field, worked = _fit(steps, source, cells, split, options, gpu)
    with source.blamed(steps, "storing the values"):
        refitted = fill_octree(octree, field)
    with target.writing(steps, refitted, no_child=no_child) as written:
        del octree, cells, field, refitted
        with steps.phase(f"reading {target.name}"), read_back_as(target.path):
            loaded: io.Loaded[Any] = io.load_with_format(written.path)
        after = _measure(steps, Source(target.path), loaded.scene, split, options, render)
    found = RefitResult(target.path, str(loaded.scene), loaded.size, before, after, worked)
    was, now = found.psnr
    io.report_result(psnr=now)
    steps.say(f"{target.name}: {now:.2f} dB on {split.held_out}, where {source.name} has {was:.2f}")
    return found


def _require(target: Target, no_child: int | None) -> None:
    """Raise NerfbakeError if an octree cannot be written to the target."""
    target.require_read_back("refit")
    target.require("SparseVoxelOctree", no_child=no_child)


def _fit(
    steps: Steps, source: Source, cells: BrickField, split: SplitViews, options: RefitOptions, gpu: Gpu | None
) -> tuple[BrickField, float]:
    """Fit the values of the cells to the pictures. Return the new field and the CPU seconds."""
    from nerfbake.stages.brick_field_to_brick_field import refit_bricks

    clock, views = Clock(), len(split.training.pictures)
    try:
        with steps.phase("refitting"), io.blame(source.name):
            for state in refit_bricks(cells, split.training, **vars(options), gpu=gpu):
                done = options.epochs if state.done else state.epoch + state.view / views
                progress.report(
                    done / options.epochs, f"epoch {min(state.epoch + 1, options.epochs)} of {options.epochs}"
                )
            return state.field(), clock.worked
    except DeviceError as error:
        if gpu is None:
            raise
        steps.say(f"{error.line}; the CPU does all of it")
    return _fit(steps, source, cells, split, options, None)


def _measure(
    steps: Steps, file: Source, scene: Any, split: SplitViews, options: RefitOptions, render: Renderer
) -> tuple[ViewError, ...]:
    """Measure the pictures of a scene on the held-out views."""
    with file.blamed(steps, f"measuring {file.name} on {len(split.held_out.pictures)} pictures"):
        return measure_views(build_field(scene), split.held_out, samples=options.samples, render=render)
