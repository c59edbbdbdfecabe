"""Fit a sparse field to photographs, and write it in any format that can store it."""

from __future__ import annotations

import threading
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal

from nerfbake import catalog, io, progress
from nerfbake.device.adapters import open_device
from nerfbake.errors import DeviceError, Stopped, UsageError
from nerfbake.installation import require_installed
from nerfbake.jobs.compressions import CompressionGoal, coded_size_of
from nerfbake.jobs.devices import renderer_with
from nerfbake.jobs.files import AnySource, AnyTarget, Source, Target, as_source, as_target, read_back_as
from nerfbake.jobs.fit_options import FitOptions
from nerfbake.jobs.fit_state import CheckpointWriter, CurvePoint, FitRun, interrupts, kept_as_partial, write_partial
from nerfbake.jobs.mesh_options import MeshFile
from nerfbake.jobs.meshes import build_mesh, require_mesh
from nerfbake.jobs.photographs import (
    MeasuredViews,
    PhotographOptions,
    SplitViews,
    cut_out,
    mean_of,
    read_photographs_in,
)
from nerfbake.jobs.poses import require_poses
from nerfbake.jobs.splats import SplatsOptions, fitted_splats
from nerfbake.jobs.steps import SILENT, Steps, Tell
from nerfbake.jobs.upright import fields_turned_up
from nerfbake.jobs.world import WorldOptions
from nerfbake.kernels.arrays import Floats
from nerfbake.kernels.soundness import all_within
from nerfbake.scene.brick_field import BrickField
from nerfbake.scene.held_out import HeldOut
from nerfbake.scene.mesh import Meshes
from nerfbake.scene.n3tree import N3Tree
from nerfbake.scene.origin import choose_origin_of_cameras, lost_origin, no_origin, origin_text
from nerfbake.scene.quantised_octree import QuantisedOctree
from nerfbake.scene.schedule import Schedule, scenery_scale
from nerfbake.scene.splats import Splats, Up
from nerfbake.scene.views import Views, world_box
from nerfbake.stages.brick_field_to_n3tree import build_n3tree
from nerfbake.stages.brick_field_to_octree import build_octree_from_bricks
from nerfbake.stages.brick_field_to_vdb import build_vdb_from_bricks
from nerfbake.stages.field_to_splats import build_splats
from nerfbake.stages.half import LARGEST
from nerfbake.stages.octree_to_compression import compress_octree
from nerfbake.stages.origins import origin_of
from nerfbake.stages.scene_to_field import build_field, build_field_from_bricks
from nerfbake.stages.views_to_error import ViewError, measure_silhouettes, measure_views, plain_psnr

if TYPE_CHECKING:
    from nerfbake.device.gpu import Gpu
    from nerfbake.stages.views_to_field import FitState

Dtype = Literal["float16", "float32"]


def _tree(field: BrickField, dtype: Dtype | None, held_out: HeldOut | None) -> N3Tree:
    """Return a PlenOctree that stores the held-out pixels. dtype None: float16 if all values fit, else float32."""
    if dtype is None:
        dtype = "float16" if all_within(field.values, LARGEST) else "float32"
    return replace(build_n3tree(field, dtype=dtype), held_out=held_out)


def _compressed(field: BrickField, held_out: HeldOut | None, target: Target, tell: Tell) -> QuantisedOctree:
    """Compress a field like `nerfbake compress` without options."""
    octree, coded_size = build_octree_from_bricks(field), coded_size_of(target)
    options = {**CompressionGoal().options, "held_out": held_out}
    return compress_octree(octree, coded_size=coded_size, tell=tell, **options).quantised


def _held_out(views: Views, samples: int) -> HeldOut | None:
    """Return the pixels of the held-out views, with the rays per pixel that they are measured with.

    None if pixels are ignored, which HeldOut cannot express.
    """
    if views.scenery and views.masked:
        return None
    cameras = replace(views.cameras, samples=samples)
    photographs = map(views.photograph, range(len(views.pictures)))
    return HeldOut.of(cameras, photographs, background=views.background)


# Types of scene that a fit writes, in the order in which their file extensions are tried: longer ones first.
KINDS = ("SparseVoxelOctree", "QuantisedOctree", "Volume", "Splats", "N3Tree", "Meshes")
_OPTIONS = {"N3Tree": {"packing": "deflated"}}  # options of the format: svox deflates its files, too
_IN_SINGLES = ("Meshes", "Splats", "N3Tree")  # types of scene whose formats store positions as float32
_OF_INNER_CUBE = ("Meshes", "Splats")  # types of scene that store only the inner cube of a scene with scenery
_FEW = 20  # views of scenery
_AGREEMENT = 0.12  # of depths, below which poses are probably wrong (docs/tuning.md, "Depths and wrong poses")
_CHECK = "check that the poses belong to these pictures, in this order, and are not mirrored"
_MASKS = "; an object before a dark or changing background needs `masks`"
_POOR = 4.0  # dB above pictures of a single colour


@dataclass(frozen=True)
class FitResult(MeasuredViews):
    """The result of a fit, measured on the written file.

    path      path of the file; content: description of its contents; bytes: its size
    schedule  the schedule, in the notation of --epochs
    views     error of the file on each of the held-out views
    device    name of the graphics device that did the work, or cpu
    worked    CPU seconds, without compiling kernels and without measuring; passed: the same in wall-clock seconds
    curve     quality during the fit
    overlap   of what a photograph with scenery shows, the share that two others show, too: a mean from 0 to 1
    agreement of the pixels that look alike in neighbouring photographs, the share whose depth others confirm, 0 to 1
    alone     names of the photographs whose places no other one shows
              The last three are only measured for scenery at the start of a fit; else None, None, ()
    """

    path: str
    content: str
    bytes: int
    schedule: str
    device: str
    views: tuple[ViewError, ...]
    worked: float
    passed: float
    curve: tuple[CurvePoint, ...]
    overlap: float | None
    agreement: float | None
    alone: tuple[str, ...]

    @property
    def corrected(self) -> float:
        """Mean PSNR over the views in dB, with the exposure of each view corrected."""
        return mean_of(self.views, "corrected")


def fit_scene(
    source: AnySource,
    *,
    photographs: PhotographOptions = PhotographOptions(),
    options: FitOptions = FitOptions(),
    world: WorldOptions = WorldOptions(),
    dtype: Dtype | None = None,
    steps: Steps = SILENT,
) -> N3Tree:
    """Return the PlenOctree that fit_file() would write as .npz, without writing or measuring it.

    The same views are held out as by fit_file(), so the scene is the same. Raises NerfbakeError.

    >>> tree = fit_scene("photographs", options=FitOptions(preset="fast", resolution=32, basis="SH1"))
    >>> tree.data_format
    'SH1'
    """
    source = as_source(source)
    photographs.require()
    options.schedule()
    gpu = open_device(options.device)
    split, schedule = _read(steps, source, photographs, world, options, "N3Tree", gpu)
    run = FitRun(split, schedule, options.rays(schedule), gpu)
    field = _fit(steps, source, split, schedule, options, run, None, threading.Event())
    with steps.phase("putting the field together"):
        return _tree(field, dtype, _held_out(split.held_out, options.rays(schedule)))


def fit_file(
    source: AnySource,
    target: AnyTarget,
    *,
    photographs: PhotographOptions = PhotographOptions(),
    options: FitOptions = FitOptions(),
    world: WorldOptions = WorldOptions(),
    dtype: Dtype | None = None,
    state: str | None = None,
    steps: Steps = SILENT,
    report: Callable[[FitResult], None] | None = None,
) -> FitResult:
    """Fit a sparse field to the photographs of a capture and return the quality of its file. This is `nerfbake fit`.

    Reads the cameras and pictures of `source` and `photographs`; a folder of photographs without cameras gets their
    poses from find_poses() first. Writes `target`, whose extension selects the type of scene, and checkpoints to the
    folder `state`. A run that was killed resumes from the last checkpoint and writes the same bytes. Ctrl-C writes the
    current state as `target`.partial and raises Stopped (exit code 130). If the file cannot be measured, it is kept
    under this name. Raises NerfbakeError.

    world   the unit and the axes of the scene, in place of those of the cameras
    dtype   number type of a PlenOctree's values; None: float16, or float32 if a value is too large for float16
    report  is called with the result

    >>> fitted = fit_file("photographs", "fitted.npz", options=FitOptions(preset="fast", resolution=32, basis="SH1"))
    >>> fitted.psnr > 15
    True
    """
    source, target = as_source(source), as_target(target)
    photographs.require()
    options.schedule()  # reports contradictory options before any picture is read
    kind = _require(target)
    if dtype is not None and kind != "N3Tree":
        raise UsageError(f"`dtype` has no effect on {target.path}; allowed: with a PlenOctree")
    if state is not None:
        io.require_checkpoints(state)
    gpu = open_device(options.device)
    split, schedule = _read(steps, source, photographs, world, options, kind, gpu)
    held_out = split.held_out
    if held_out.scenery and kind not in ("N3Tree", *_OF_INNER_CUBE):
        found = f"{source.name} has scenery behind the object, which {target.path} cannot store"
        raise UsageError(f"{found}; allowed: a PlenOctree, a mesh or splats of the inner cube, or masks of the object")
    steps.say(f"{source.name}: fits to {split.training}, measures on {held_out}")
    if held_out.scenery and len(split.training.pictures) < _FEW:
        few = f"{len(split.training.pictures)} views are few for scenery"
        steps.say(f"{source.name}: {few}; parts that fewer than three of them show are placed far away")
    steps.say(f"{source.name}: `epochs={schedule}`")
    checkpoints = (
        None
        if state is None
        else CheckpointWriter(state, options.fingerprint(schedule, split.training), split.training)
    )
    run = FitRun(split, schedule, options.rays(schedule), gpu)
    with ExitStack() as output:
        with interrupts() as interrupted:
            field = _fit(steps, source, split, schedule, options, run, checkpoints, interrupted)
            if kind not in _IN_SINGLES:
                field, split = _in_world(field, split)
                held_out = split.held_out
            if held_out.scenery and kind in _OF_INNER_CUBE:
                steps.say(f"{source.name}: has scenery; {target.path} shows the inner cube")
                field = field.shell(0)
                split = cut_out(steps, source, split, build_field_from_bricks(field))
                held_out = split.held_out
            scene = _converted(steps, source, target, kind, field, split, options.rays(schedule), dtype, interrupted)
            if kind in _IN_SINGLES:
                scene = _with_origin(steps, scene, target, kind, split.origin)
            up: Up | None = None
            if kind == "Splats":
                keeps_up = io.format_for(target.path, kind, to=target.to).load_splat_module().KEEPS_UP
                (scene,), up = fields_turned_up((scene,), None, keeps_up=keeps_up)
            del field, split
            if interrupted.is_set():
                write_partial(steps, target, kind, scene, state, **_options(target, kind))
            written = output.enter_context(target.writing(steps, scene, **_options(target, kind)))
        del scene
        if not interrupted.is_set():
            with kept_as_partial(steps, target, written):
                fitted = _judged(steps, target, written, held_out, schedule, options, run, up)
    if interrupted.is_set():
        raise Stopped(f"stopped before the quality was measured: {target.path} is complete")
    if report is not None:
        report(fitted)
    return fitted


def _in_world(field: BrickField, split: SplitViews) -> tuple[BrickField, SplitViews]:
    """Return a field and its views in the world of the capture, whose coordinates its formats store as float64."""
    if not split.origin.any():
        return field, split
    return replace(field, box=field.box + split.origin), split.moved(no_origin())


def _with_origin(steps: Steps, scene: Any, target: Target, kind: str, origin: Floats) -> Any:
    """Return a scene whose format stores float32, with the origin of the fit, if the format keeps it."""
    if not origin.any():
        return scene
    form = io.format_for(target.path, kind, to=target.to)
    if kind == "N3Tree" or (kind == "Splats" and not form.load_splat_module().KEEPS_ORIGIN):
        steps.say(f"{target.name}: {lost_origin(origin, form.suffix)}")
        return scene
    return replace(scene, origin=origin)


def _read(
    steps: Steps,
    source: Source,
    photographs: PhotographOptions,
    world: WorldOptions,
    options: FitOptions,
    kind: str,
    gpu: Gpu | None,
) -> tuple[SplitViews, Schedule]:
    """Read the photographs of a capture, and return the schedule for them.

    Pictures with scenery are reduced to the size that the last stage uses: larger ones only take longer to measure. A
    mesh and splats are then fitted to them once more, so they need the larger ones.
    """
    if require_poses(steps, source, world):
        world = WorldOptions()  # the poses are in it
    split = read_photographs_in(steps, source, photographs, world)
    if (origin := choose_origin_of_cameras(split.training.cameras.eyes)).any():
        steps.say(f"{source.name}: the cameras are far from 0; the fit is relative to {origin_text(origin)}")
        split = split.moved(origin)
    schedule = options.schedule(split.training, gpu=gpu)
    if not split.training.scenery or kind in _OF_INNER_CUBE:
        return split, schedule
    edge = min(min(camera.width, camera.height) for views in split for camera in views.cameras.cameras)
    if (factor := scenery_scale(edge, schedule.finest)) > 1:
        split = SplitViews(*(views.reduced(factor) for views in split))
        schedule = options.schedule(split.training, gpu=gpu)
        first = split.training.cameras.cameras[0]
        steps.say(f"{source.name}: fits to and measures on pictures of {first.width}x{first.height} pixels")
    return split, schedule


def _require(target: Target) -> str:
    """Return the type of scene of the target. Raises NerfbakeError if a field cannot be written there."""
    target.require_read_back("fit")
    kinds = [kind for kind in KINDS if catalog.is_ending(target.ending, kind)]
    kind = kinds[0] if kinds else None
    # Meshes and splats share extensions. Such a file is a mesh if its format has a texture, and splats otherwise.
    if "Meshes" in kinds and io.format_for(target.path, "Meshes", to=target.to).choices("image"):
        kind = "Meshes"
    if kind is None:
        endings = ", ".join(dict.fromkeys(form.suffix for kind in KINDS for form in catalog.formats_of(kind)))
        found = f"{target.ending!r} is not the extension of a field or a mesh"
        raise UsageError(f"{found}; allowed: {endings}, or `to=FORMAT`")
    if library := target.require(kind).library:
        require_installed(library, "measuring the file that fit wrote")
    if kind == "Meshes":
        require_mesh(target)
    return kind


def _options(target: Target, kind: str) -> dict[str, Any]:
    """Return the options of the target's format."""
    if kind == "Meshes":
        return MeshFile().options(io.format_for(target.path, kind, to=target.to))
    return _OPTIONS.get(kind, {})


def _fit(
    steps: Steps,
    source: Source,
    split: SplitViews,
    schedule: Schedule,
    options: FitOptions,
    run: FitRun,
    checkpoints: CheckpointWriter | None,
    interrupted: threading.Event,
) -> BrickField:
    """Fit until the schedule ends, or until Ctrl-C sets `interrupted`, and return the field."""
    from nerfbake.stages.views_to_field import fit_field

    views = split.training
    state = start = _start(steps, checkpoints, run)
    if run.gpu is not None:
        steps.say(f"{source.name}: fits on {run.device}")
    with steps.phase("fitting"), io.blame(source.name):
        box = None if options.box is None else world_box(options.box) - split.origin
        chosen: dict[str, Any] = {"basis": options.basis_of(views), "box": box, "seed": options.seed}
        chosen |= {"schedule": schedule, "exposure": options.gains(views)}
        while True:
            try:
                for number, state in enumerate(fit_field(views, start=start, gpu=run.gpu, **chosen)):
                    if number == 0 and start is None:
                        run.overlap = state.overlap
                        _tell_overlap(steps, source, run)
                    with progress.listening(None):  # measuring does not report progress
                        ended = run.follow(state)
                    if checkpoints is not None and (ended or interrupted.is_set() or checkpoints.is_due):
                        _keep(checkpoints, state, run)
                    progress.report(run.share(state), run.progress_text(state))
                    if interrupted.is_set():
                        break
                assert state is not None, "a schedule has at least one step"
                return state.field()
            except DeviceError as error:
                steps.say(f"{error.line}; {run.go_on_without_device(state)}")
                start = state


def _tell_overlap(steps: Steps, source: Source, run: FitRun) -> None:
    """Print how much pictures with scenery show together; if they do not agree, that the poses are probably wrong."""
    share, agreement, alone = run.shared
    if share is not None:
        steps.say(f"{source.name}: on average, two other pictures show {share:.0%} of what a picture shows")
    if agreement is not None and agreement < _AGREEMENT:
        found = f"neighbouring pictures agree on the depth of {agreement:.0%} of what looks alike in them"
        steps.say(f"{source.name}: {found}; right poses mostly give 16% or more; {_CHECK}")
    elif alone:
        steps.say(f"{source.name}: hardly any other picture shows what these show: {', '.join(alone)}")


def _start(steps: Steps, checkpoints: CheckpointWriter | None, run: FitRun) -> FitState | None:
    """Return the state in the last checkpoint, or None if there is none. Prints that another device worked on it."""
    last = None if checkpoints is None else checkpoints.last()
    if last is None:
        return None
    from nerfbake.stages.views_to_field import FitState

    with io.blame(last.path):
        state = FitState.of_arrays(last.arrays)
    run.goes_on(state, last)
    if others := [name for name in run.devices if name != run.device]:
        steps.say(f"{last.path}: is from {' and '.join(others)}; with {run.device} the fit ends in other bytes")
    return state


def _keep(checkpoints: CheckpointWriter, state: FitState, run: FitRun) -> None:
    worked, passed = run.clock.worked, run.clock.passed
    with run.clock.paused():
        checkpoints.keep(state, worked=worked, passed=passed, curve=run.curve, devices=run.devices)


def _converted(
    steps: Steps,
    source: Source,
    target: Target,
    kind: str,
    field: BrickField,
    split: SplitViews,
    rays: int,
    dtype: Dtype | None,
    interrupted: threading.Event,
) -> Any:
    """Return a fitted field as the type of scene of the target. A mesh and splats are fitted to the views once more."""
    with steps.phase("putting the field together") as tell, io.blame(target.path):
        match kind:
            case "SparseVoxelOctree":
                return build_octree_from_bricks(field)
            case "QuantisedOctree":
                return _compressed(field, _held_out(split.held_out, rays), target, tell)
            case "Volume":
                form = io.format_for(target.path, kind, to=target.to)
                return build_vdb_from_bricks(field, grids=form.load_volume_module().FIELD_GRIDS)
            case "N3Tree":
                return _tree(field, dtype, _held_out(split.held_out, rays))
        whole = build_field_from_bricks(field)
        splats = build_splats(whole) if kind == "Splats" else None
    if splats is None:
        return build_mesh(steps, source, whole, split.training, target)
    return (
        splats
        if interrupted.is_set()
        else fitted_splats(steps, source, splats, split.training, SplatsOptions(), interrupted)
    )


def _judged(
    steps: Steps,
    target: Target,
    written: io.PendingFile,
    held_out: Views,
    schedule: Schedule,
    options: FitOptions,
    run: FitRun,
    up: Up | None,
) -> FitResult:
    """Read the written file and measure it on the held-out views. up: the axis by which splats were turned."""
    samples = options.rays(schedule)
    worked, passed = run.clock.worked, run.clock.passed
    with Source(target.path).blamed(steps, f"measuring on {len(held_out.pictures)} pictures"):
        with steps.phase(f"reading {target.name}"), read_back_as(target.path):
            loaded: io.Loaded[Any] = io.load_with_format(written.path)
        read = loaded.scene if up is None else loaded.scene.without_up(up)
        scene = read if isinstance(read, Meshes | Splats) else build_field(read)
        content, size, start = str(loaded.scene), loaded.size, origin_of(read)
        del loaded, read  # a tree is nearly as large as its field
        if start.any():  # a reader may choose another one than the fit did
            near = held_out.cameras.relative_to(start - held_out.cameras.origin)
            held_out = replace(held_out, cameras=near)
        views = measure_views(scene, held_out, samples=samples, render=renderer_with(steps, run.gpu))
        shapes = measure_silhouettes(scene, held_out) if isinstance(scene, Meshes) else ()
    facts = target.path, content, size, str(schedule), run.device
    fitted = FitResult(*facts, views, worked, passed, tuple(run.curve), *run.shared)
    io.report_result(psnr=fitted.psnr)
    corrected = f" ({fitted.corrected:.2f} dB with their exposures corrected)" if options.gains(held_out) else ""
    rays = replace(held_out.cameras, samples=samples).rays_text
    outlines = f", silhouettes' IoU {sum(shapes) / len(shapes):.4f}" if shapes else ""
    seen = f"{fitted.psnr:.2f} dB{corrected}, SSIM {fitted.ssim:.4f}{outlines} on {held_out}{rays}"
    steps.say(f"{target.path}: {seen}; after {worked:.0f} CPU seconds, {passed:.0f} seconds")
    if fitted.psnr < (plain := plain_psnr(held_out)) + _POOR:
        advice = _CHECK + (_MASKS if held_out.scenery else "")
        steps.say(f"{target.path}: a poor fit; pictures of a single colour have {plain:.2f} dB; {advice}")
    return fitted
