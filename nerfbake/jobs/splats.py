"""Bake Gaussian splats: the visible leaves of a field, or fewer of a file's splats, fitted to pictures."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from nerfbake import catalog, io, progress
from nerfbake.errors import UsageError
from nerfbake.jobs.budgets import FRAMES, Budget, reporting
from nerfbake.jobs.devices import renderer_on
from nerfbake.jobs.files import (
    AnySource,
    AnyTarget,
    FolderTarget,
    Source,
    Target,
    as_source,
    as_target,
    read_back,
    read_back_as,
)
from nerfbake.jobs.fit_state import Clock, interrupts, kept_as_partial, write_partial, write_partial_folder
from nerfbake.jobs.fitted_pictures import PICTURES, FittedPictures
from nerfbake.jobs.function_voxels import FunctionVoxels
from nerfbake.jobs.photographs import (
    MeasuredViews,
    SplitViews,
    mean_of,
    read_photographs,
    render_split,
    require_alike,
)
from nerfbake.jobs.readings import Reading
from nerfbake.jobs.splat_choice import SplatChoice
from nerfbake.jobs.splat_parts import Placement, SplatParts, read_joined, require_places, require_sources
from nerfbake.jobs.steps import SILENT, Steps
from nerfbake.jobs.upright import fields_turned_up, require_up, turned_up
from nerfbake.jobs.views import picture_views
from nerfbake.scene.radiance_field import RadianceField
from nerfbake.scene.splat_levels import SplatLevels
from nerfbake.scene.splats import Splats, Up
from nerfbake.scene.views import Views
from nerfbake.stages.field_to_splats import COUNT, build_splats
from nerfbake.stages.renderers import Renderer
from nerfbake.stages.scene_to_cameras import orbit_cameras, without_strays
from nerfbake.stages.splats_to_splats import merge_splats
from nerfbake.stages.views_to_error import ViewError, measure_views

LEVELS, LESS = 4, 4  # levels of detail, each with a quarter of the splats of the one before
_ZOOM = 1.13  # the object fills the pictures about as in photographs


@dataclass(frozen=True, kw_only=True)
class SplatsViews(FittedPictures):
    """The pictures that splats are fitted to. The arguments are those of FittedPictures."""

    def split(self, steps: Steps, source: Source, field: RadianceField, render: Renderer) -> SplitViews:
        """Return the training views and the held-out views. Raises NerfbakeError if they show something else."""
        if self.views is not None:
            return self.photographs_of(steps, source, field, render)
        with source.blamed(steps, f"rendering pictures of {source.name}"):
            framed = without_strays(field)
            return render_split(
                field, frames=self.frames or PICTURES, edge=self.edge, framed=framed, zoom=_ZOOM, render=render
            )

    def split_of(self, steps: Steps, source: Source, splats: Splats, render: Renderer, *, fitted: bool) -> SplitViews:
        """Return the same of splats. fitted: without it, the training views are not needed, and may be any others."""
        if self.views is not None:
            split = read_photographs(steps, Source(self.views), self.photographs).moved(splats.origin)
            require_alike(steps, source, splats, split.held_out, self.views, render)
            return split
        with source.blamed(steps, f"rendering pictures of {source.name}"):
            if fitted:
                return render_split(splats, frames=self.frames or PICTURES, edge=self.edge, zoom=_ZOOM, render=render)
            around = orbit_cameras(splats, frames=FRAMES, width=self.edge, height=self.edge)
            held_out = picture_views(splats, around, 1, render)
            return SplitViews(held_out, held_out)


@dataclass(frozen=True, kw_only=True)
class SplatsOptions:
    """How many splats there are, and how they are fitted.

    splats  the largest number of splats; None: 150,000 of a field, all of splats
    levels  of OUT lod-meta.json: levels of detail, each with a quarter of the splats of the one before; None: 4
    place   where splats of an input are put before they are joined, cut and merged; of splats only
    parts   which splats of the input are kept; of splats only
    epochs  passes over the pictures; 0: merged splats are not fitted
    seed    of the order of the pictures
    """

    splats: int | None = None
    levels: int | None = None
    place: tuple[Placement, ...] = ()
    parts: SplatParts = SplatParts()
    epochs: int = 4
    seed: int = 0


class LevelQuality(NamedTuple):
    """A level of detail: its number of splats, and its mean PSNR in dB and SSIM on the held-out views."""

    splats: int
    psnr: float
    ssim: float

    @staticmethod
    def of(level: Splats, views: Sequence[ViewError]) -> LevelQuality:
        return LevelQuality(level.n, mean_of(views, "psnr"), mean_of(views, "ssim"))

    def __str__(self) -> str:
        return f"{self.splats:,} splats, {self.psnr:.2f} dB, SSIM {self.ssim:.4f}"


@dataclass(frozen=True)
class SplatsResult(MeasuredViews):
    """The result of baking splats, measured on what was written.

    path    path of the file; content: description of its contents; bytes: its size; splats: their number
    views   error of the file, or of its finest level, on each of the held-out views
    worked  CPU seconds, without compiling kernels and without measuring; passed: the same in wall-clock seconds
    levels  quality of each level of detail, the finest first; of a single file none
    up       the axis of the world of the source by which they were turned upright; None: they were not
    """

    path: str
    content: str
    bytes: int
    splats: int
    views: tuple[ViewError, ...]
    worked: float
    passed: float
    levels: tuple[LevelQuality, ...] = ()
    up: Up | None = None


def bake_splats(
    source: AnySource | Sequence[AnySource],
    target: AnyTarget,
    pictures: SplatsViews = SplatsViews(),
    *,
    options: SplatsOptions = SplatsOptions(),
    in_up: str | None = None,
    choice: SplatChoice = SplatChoice(),
    functions: FunctionVoxels = FunctionVoxels(),
    min_psnr: float | None = None,
    steps: Steps = SILENT,
    report: Callable[[SplatsResult], None] | None = None,
) -> SplatsResult:
    """Turn a field into splats, or splats into fewer, fit them to pictures, and return the quality of the file.

    This is `nerfbake splats`. Reads `source`, any scene with a field, or splats, also of several files, which are
    joined; and the photographs of `pictures`. Splats are cut and merged before the fit; if none are merged, they are
    fitted to photographs alone. Writes `target`, or `target`.rejected if it is below `min_psnr`, in dB on the held-out
    views. Ctrl-C writes the current state as `target`.partial and raises Stopped (exit code 130). If the file cannot be
    measured, it is kept under this name. Raises NerfbakeError.

    For a `target` FOLDER/lod-meta.json, the folder has levels of detail. Each further level is merged from the one
    before, and fitted to the same pictures; `min_psnr` is a limit for the finest.

    in_up   the axis of the world of `source` that points up: x, -x, y, -y, z or -z. The splats are rotated so that it
            becomes -y, which formats of splats store as their own up axis. None: splats of splats are not rotated; of a
            field it is z, and a format that says that z is up stores them as they are. -y: they are not rotated
    choice  their axes in the files, and how they are written
    functions  how a trained field becomes voxels
    report  is called with the result, also if it is below `min_psnr`

    >>> options = SplatsOptions(splats=400, epochs=4)
    >>> baked = bake_splats("a.npz", "a.ply", SplatsViews(frames=6, edge=48), options=options)
    >>> baked.splats <= 400, baked.psnr > 15
    (True, True)
    """
    sources = [as_source(source)] if isinstance(source, Source | str | Path) else [as_source(each) for each in source]
    target = as_target(target)
    pictures.photographs.require()
    up, written_as = require_up(in_up), choice.of_format
    folder = target.folder("SplatLevels")
    form = _require(target, folder, sources, options, min_psnr, written_as)
    require_sources(sources)
    require_places(options.place, len(sources))
    keeps_up = folder is None and form.load_splat_module().KEEPS_UP
    levels = 0 if folder is None else options.levels or LEVELS
    render = renderer_on(pictures.device, steps=steps)
    made = _make(steps, sources, pictures, options, functions, up, choice, render, keeps_up=keeps_up, levels=levels)
    splats = made.levels[0]
    place, scene = (target, splats) if folder is None else (folder, SplatLevels(made.levels))
    if made.is_interrupted:
        if folder is not None:
            write_partial_folder(steps, folder, scene)
        write_partial(steps, target, "Splats", splats)
    reported = reporting(lambda: report(found) if report is not None else None)
    with reported, place.writing(steps, scene, **written_as) as written:
        with kept_as_partial(steps, place, written):
            held_out = made.split.held_out
            each_level, content = _measured(steps, target, written, held_out, scene, made.up, written_as, render)
        qualities = tuple(map(LevelQuality.of, made.levels, each_level)) if folder is not None else ()
        worked, passed = made.seconds
        found = SplatsResult(
            target.path, content, written.size, splats.n, each_level[0], worked, passed, qualities, made.up
        )
        if folder is not None:
            steps.say(f"{folder.path}: {scene}, {written.size:,} bytes")
        for number, level in enumerate(qualities):
            steps.say(f"{target.path}: level {number}: {level}")
        io.report_result(psnr=found.psnr)
        judged_on = f"{made.split.held_out}{made.against}"
        Budget(min_psnr=min_psnr).judge(found.psnr, "the splats have", judged_on)
        seen = f"{found.psnr:.2f} dB, SSIM {found.ssim:.4f} on {judged_on}"
        steps.say(f"{target.path}: {seen}; after {worked:.0f} CPU seconds, {passed:.0f} seconds")
    return found


class _Made(NamedTuple):
    """Splats by level, the finest first, and the views that they were fitted to and that judge them.

    up: the axis of the world of the views by which the splats were turned; None: they were not. against: what the views
    show, in words. is_interrupted: Ctrl-C stopped a fit. seconds: of CPU, and wall-clock.
    """

    levels: tuple[Splats, ...]
    up: Up | None
    split: SplitViews
    against: str
    is_interrupted: bool
    seconds: tuple[float, float]


def _make(
    steps: Steps,
    sources: Sequence[Source],
    pictures: SplatsViews,
    options: SplatsOptions,
    functions: FunctionVoxels,
    up: Up | None,
    choice: SplatChoice,
    render: Renderer,
    *,
    keeps_up: bool,
    levels: int,
) -> _Made:
    """Read the sources, and return their splats, merged, fitted, and upright in OUT.

    keeps_up: OUT says which axis points up. levels: those of OUT, 0 if it has none.
    """
    first = sources[0]
    reading = Reading(steps, first, *((Splats,) if len(sources) > 1 else ()), functions=functions)
    reading.require()
    options.parts.require(reading)
    reading.require(taken={"in_axes": (Splats,)}, in_axes=choice.in_axes)
    reading.require(taken={"place": (Splats,)}, place=options.place or None)
    clock = Clock()
    if not isinstance(reading.scene, Splats):
        if not options.epochs:
            raise UsageError("`epochs` 0 has no effect on a field; allowed: with splats that are merged")
        reading.use_inner_cube()
        field = reading.field(visible="nothing to fit splats to")
        del reading
        split, against = pictures.split(steps, first, field, render), ""
        with interrupts() as interrupted:
            splats = splats_of_field(steps, first, field, split, pictures, options, interrupted)
            del field
            made = _with_levels(steps, first, splats, split.training, options, interrupted, levels)
        with first.blamed(steps, "turning the splats"):
            made, up = fields_turned_up(made, up, keeps_up=keeps_up)
    else:
        original = options.parts.of(steps, first, read_joined(steps, sources, reading.scene, choice, options.place))
        del reading
        count = options.splats or original.n
        merged = count < original.n
        fitted = options.epochs > 0 and (merged or levels > 1 or pictures.views is not None)
        split = pictures.split_of(steps, first, original, render, fitted=fitted)
        against = "" if pictures.views else f" of {first.name}" if len(sources) == 1 else " of the joined splats"
        with interrupts() as interrupted:
            with first.blamed(steps, "merging splats"):
                splats = merge_splats(original, count=count)
            del original
            if fitted:
                steps.say(f"{first.name}: fits {splats} to {split.training}, measures on {split.held_out}{against}")
            if fitted and (merged or pictures.views is not None):
                splats = fitted_splats(steps, first, splats, split.training, options, interrupted)
            made = _with_levels(steps, first, splats, split.training, options, interrupted, levels)
        with first.blamed(steps, "turning the splats"):
            made = turned_up(steps, first, up, *made)
    return _Made(made, up, split, against, interrupted.is_set(), (clock.worked, clock.passed))


def _with_levels(
    steps: Steps,
    source: Source,
    finest: Splats,
    views: Views,
    options: SplatsOptions,
    interrupted: threading.Event,
    levels: int,
) -> tuple[Splats, ...]:
    """Return the finest level, and the further ones until there are so many, one has one splat, or Ctrl-C."""
    made = [finest]
    while len(made) < levels and made[-1].n > 1 and not interrupted.is_set():
        with source.blamed(steps, f"merging splats for level {len(made)}"):
            splats = merge_splats(made[-1], count=-(-made[-1].n // LESS))
        if options.epochs:
            splats = fitted_splats(steps, source, splats, views, options, interrupted)
        made.append(splats)
    return tuple(made)


def splats_of_field(
    steps: Steps,
    source: Source,
    field: RadianceField,
    split: SplitViews,
    pictures: SplatsViews,
    options: SplatsOptions,
    interrupted: threading.Event,
) -> Splats:
    """Build splats of a field, and fit them to the split of its pictures until the end, or until Ctrl-C."""
    steps.say(f"{source.name}: fits splats to {split.training}, measures on {split.held_out}")
    with source.blamed(steps, "choosing leaves"):
        cameras = split.training.cameras if pictures.views else None
        splats = build_splats(field, count=options.splats or COUNT, cameras=cameras)
    return fitted_splats(steps, source, splats, split.training, options, interrupted)


def fitted_splats(
    steps: Steps, source: Source, splats: Splats, views: Views, options: SplatsOptions, interrupted: threading.Event
) -> Splats:
    """Fit splats to views until the end, or until Ctrl-C sets `interrupted`."""
    from nerfbake.stages.views_to_splats import fit_splats

    total = options.epochs * len(views.pictures)
    with source.blamed(steps, "fitting splats"):
        for state in fit_splats(splats, views, epochs=options.epochs, seed=options.seed):
            done = state.epoch * len(views.pictures) + state.view
            progress.report(done / total, f"epoch {min(state.epoch + 1, options.epochs)} of {options.epochs}")
            if interrupted.is_set():
                break
        return state.splats()


def _require(
    target: Target,
    folder: FolderTarget | None,
    sources: Sequence[Source],
    options: SplatsOptions,
    min_psnr: float | None,
    written_as: dict[str, Any],
) -> catalog.AnyFormat:
    """Return what is written. Call it before doing any work. Raises NerfbakeError."""
    if folder is not None:
        Budget(min_psnr=min_psnr).require_folder(folder, "SplatLevels", [source.path for source in sources])
        kind = catalog.folder_to_write("SplatLevels")
        kind.require_options(written_as)
        return kind
    if options.levels is not None:
        raise UsageError("`levels` has no effect on a single file; allowed: with lod-meta.json in a folder as OUT")
    target.require_read_back("splats")
    form = target.require("Splats", **written_as)
    Budget(min_psnr=min_psnr).require(target)
    return form


def _measured(
    steps: Steps,
    target: Target,
    written: io.PendingFile,
    held_out: Views,
    scene: Splats | SplatLevels,
    up: Up | None,
    written_as: dict[str, Any],
    render: Renderer,
) -> tuple[list[tuple[ViewError, ...]], str]:
    """Read what was written, and measure each of its levels on the held-out views.

    up: the axis of the world of the views by which the splats were turned. written_as: options of the format.
    """
    with Source(target.path).blamed(steps, f"measuring on {len(held_out.pictures)} pictures"):
        if isinstance(scene, Splats):
            found = read_back(target, written.path, scene, **written_as)
            levels: tuple[Splats, ...] = (found,)
        else:
            with read_back_as(target.path):
                found = io.load_folder(written.path, SplatLevels)
            levels = found.levels
        as_viewed = (level if up is None else level.without_up(up) for level in levels)
        return [measure_views(level, held_out, render=render) for level in as_viewed], str(found)
