"""Write the cameras of any dialect in those that other programs read."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

from nerfbake import catalog, io
from nerfbake.errors import OutputError, UsageError
from nerfbake.jobs.files import AnySource, AnyTarget, Source, Target, as_source, as_target, axis_option
from nerfbake.jobs.photographs import photographs_of
from nerfbake.jobs.steps import SILENT, Steps
from nerfbake.jobs.views import read_cameras
from nerfbake.jobs.world import WorldOptions, find_world
from nerfbake.kernels.soundness import plural
from nerfbake.scene.camera import Camera, Cameras
from nerfbake.scene.origin import choose_origin_of_cameras, lost_origin

AnyForm = catalog.AnyFormat | catalog.Dialect
_LEAST_SKEW = 0.01  # pixels that a skew moves the edge of a picture by: less is not said


def convert_cameras(
    source: AnySource,
    target: AnyTarget,
    *,
    in_up: str | None = None,
    world: WorldOptions = WorldOptions(),
    steps: Steps = SILENT,
) -> Cameras:
    """Write cameras for other programs, and return them as they were written. This is `nerfbake convert` of cameras.

    Reads the cameras of `source`, a file or a folder. Writes `target`: a .json is nerfstudio's transforms.json; a
    .usda, .usdc or .usdz is a stage of USD; with to="3dgs" it is cameras.json of 3D Gaussian Splatting, and with
    to="colmap" a folder with the text of a COLMAP model. What the format has no place for is reported. Positions of
    cameras far from 0 become relative to an origin, which is printed. Raises NerfbakeError.

    in_up  the axis of their world that points up, which USD stores: y or z; None: z
    world  the unit and the axes of the written cameras, in place of those of the source

    >>> import numpy as np
    >>> _ = nerfbake.save("cameras.json", nerfbake.Cameras((nerfbake.Camera(4, 3, 5.0, np.eye(4), "front"),)))
    >>> print(convert_cameras("cameras.json", nerfbake.jobs.Target("model", to="colmap")))
    1 camera (instant-ngp)
    """
    source, target = as_source(source), as_target(target)
    form = _require(source, target, in_up)
    cameras = read_cameras(steps, source.path)
    if world.asked:
        moved = find_world(steps, source.name, cameras, world, photographs_of(source.path, cameras))
        cameras = cameras if moved is None else moved.apply(cameras)
    return _write(steps, cameras, target, form, in_up)


def write_cameras(steps: Steps, cameras: Cameras, source: Source, target: Target, *, in_up: str | None) -> Cameras:
    """Write cameras that were read from `source` as convert_cameras() does."""
    return _write(steps, cameras, target, _require(source, target, in_up), in_up)


def _require(source: Source, target: Target, in_up: str | None) -> AnyForm:
    """Return what cameras are written as. Call it before doing any work. Raises NerfbakeError."""
    form = catalog.cameras_to_write(target.ending, target.to)
    if form is None:
        suffixes = ", ".join(each.suffix for each in catalog.formats_of("Cameras"))
        raise UsageError(f"{target.path!r} is not a file of cameras; allowed: {suffixes}, or `to=colmap`")
    options = axis_option(form, in_up)
    if target.path == io.STREAM and not isinstance(form, catalog.Format):
        raise UsageError(f"stdout cannot be written as {target.to}; allowed: a path")
    if isinstance(form, catalog.FolderKind):
        if Path(target.path).parent.is_dir():  # else it is created when the cameras have been read
            contents = io.FolderContents.of(form)
            io.require_no_folder(target.path, contents, force=target.force, inputs=[source.path])
    elif isinstance(form, catalog.Format):
        target.require("Cameras", **options)
    else:
        io.require_absent(target.path, force=target.force)
    return form


def _write(steps: Steps, cameras: Cameras, target: Target, form: AnyForm, in_up: str | None) -> Cameras:
    for lost in _lost(cameras, form):
        steps.say(f"{target.name}: {lost}")
    if (origin := choose_origin_of_cameras(cameras.eyes)).any():
        steps.say(f"{target.name}: {lost_origin(origin, form.title)}")
        cameras = cameras.relative_to(origin)
    if isinstance(form, catalog.FolderKind):
        with io.blame(target.path, OutputError):
            Path(target.path).parent.mkdir(parents=True, exist_ok=True)
        with steps.phase(f"writing {target.path}"):
            contents = io.FolderContents.of(form)
            sizes = io.save_files(target.path, form.load_module().encode(cameras), contents, force=target.force)
        steps.say(f"{target.name}: {cameras}, {sum(sizes.values()):,} bytes")
        return cameras
    if isinstance(form, catalog.Dialect):
        data = b"".join(form.load_writer().encode(cameras))
        path = Path(target.path)
        with (
            steps.phase(f"writing {target.path}"),
            io.blame(target.path, OutputError),
            io.replacing(path, force=target.force) as file,
        ):
            file.write(data)
        steps.say(f"{target.name}: {cameras}, {len(data):,} bytes")
        return cameras
    named = tuple(replace(camera, name=camera.picture or camera.name) for camera in cameras.cameras)
    target.write(steps, replace(cameras, cameras=named), **axis_option(form, in_up))
    return cameras


def _lost(cameras: Cameras, form: Any) -> Iterator[str]:
    """Yield a line for each part of the cameras that a format has no place for."""
    skew = max(map(_skew, cameras.cameras))
    if skew > _LEAST_SKEW:
        yield f"warning: the skew is left out, which moves points by up to {skew:.2g} px"
    if isinstance(form, catalog.Dialect):
        lenses = (camera.lens for camera in cameras.cameras)
        bent = sum(lens is not None and lens.bends and not lens.all_round for lens in lenses)  # encode() refuses those
        if bent:
            yield (
                f"warning: the lenses of {plural(bent, 'camera')} are left out, because the format has none: it needs "
                "undistorted pictures"
            )
        if off := max(_off(cameras.cameras)):
            yield f"warning: the principal points are left out, up to {off:.2g} px from the middle of the picture"
    elif isinstance(form, catalog.Format) and cameras.points is not None:
        yield f"{plural(len(cameras.points), 'point')} left out"
    if isinstance(form, catalog.Format) and (misread := getattr(form.load_module(), "misread_lenses", None)):
        yield from misread(cameras)


def _skew(camera: Camera) -> float:
    """How far the skew moves a point at an edge of the picture, in pixels."""
    if camera.lens is None:
        return 0.0
    return abs(camera.lens.skew) * camera.fx * max(camera.cy, camera.height - camera.cy) / camera.fy


def _off(cameras: Iterable[Camera]) -> Iterator[float]:
    for camera in cameras:
        yield math.hypot(camera.cx - camera.width / 2, camera.cy - camera.height / 2)
