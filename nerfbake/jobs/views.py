"""Cameras of a job: those of a capture, or an orbit around the scene."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

from nerfbake import io, progress
from nerfbake.jobs.steps import Steps
from nerfbake.kernels.arrays import Floats
from nerfbake.scene.camera import Camera, Cameras
from nerfbake.scene.function_field import FunctionField
from nerfbake.scene.image import Image
from nerfbake.scene.mesh import Meshes
from nerfbake.scene.origin import no_origin, origin_text
from nerfbake.scene.page import COVER
from nerfbake.scene.radiance_field import RadianceField
from nerfbake.scene.splats import Splats
from nerfbake.scene.stage1 import Stage1
from nerfbake.scene.views import Views
from nerfbake.stages.origins import has_origin, origin_of
from nerfbake.stages.picture import Visible, renderable
from nerfbake.stages.pictures_to_views import build_views
from nerfbake.stages.renderers import KERNELS, Renderer
from nerfbake.stages.scene_to_cameras import orbit_cameras
from nerfbake.stages.scenes_to_comparison import compare_scenes
from nerfbake.stages.stage1_to_image import render_stage1

_OWN_EDGE = 128  # pixels along the longer edge of the pictures of a trained field, which take long


def read_cameras(steps: Steps, path: str) -> Cameras:
    """Read the cameras of a file or folder. Print which file of a folder was read, and what was assumed."""
    with steps.phase(f"reading {path}"):
        read = io.load(path, Cameras)
    tell_file_of(steps, path, read)
    for note in (*read.notes, *read.pose_notes):
        steps.say(f"{path}: {note}")
    return read


def tell_file_of(steps: Steps, path: str, cameras: Cameras) -> None:
    """Print which file of a folder cameras were read from. path: that of the folder."""
    if cameras.source:
        steps.say(f"{path}: {cameras} from {cameras.source}")


def renderable_scene(steps: Steps, scene: Any, name: str) -> Any:
    """Return an object that can be rendered: the scene itself, or its field, built once for all pictures.

    name: name of the scene in errors.
    """
    if isinstance(scene, Visible):
        return scene
    with steps.phase("building the field"), io.blame(name):
        return renderable(scene)


def views_of(
    steps: Steps,
    scene: Any,
    cameras: str | None,
    *,
    name: str,
    frames: int,
    edge: int,
    size: tuple[int, int] | None = None,
    samples: int | None = None,
    origin: Floats | None = None,
    own: bool = False,
) -> Cameras:
    """Return the cameras of a capture; without one, an orbit of `frames` views, `edge` pixels wide and high.

    name     name of the scene in errors
    size     (W, H) pixels; None: that of the capture or orbit
    samples  rays along each edge of a pixel; None: from the capture, else 1
    origin   the point of the capture's world that the scene is relative to; None: the scene's own origin
    own      without a capture, use some of the cameras that a trained field has, instead of an orbit
    """
    if cameras is None and own and isinstance(scene, FunctionField) and scene.cameras is not None:
        return scene.cameras.few(frames, min(edge, _OWN_EDGE)).chosen(size=size, samples=samples)
    if cameras is None:
        width, height = size or (edge, edge)
        with steps.phase("framing"), io.blame(name):
            orbit = orbit_cameras(scene, frames=frames, width=width, height=height)
        return orbit.chosen(samples=samples)
    start = origin_of(scene) if origin is None else origin
    read = read_cameras(steps, cameras)
    with io.blame(cameras):
        return read.chosen(size=size, samples=samples).relative_to(start)


def in_one_world(steps: Steps, scenes: Sequence[tuple[str, Any]]) -> list[Any]:
    """Return scenes, given with their names, relative to the same origin: that of the first which has one.

    Scenes without an origin may have lost it to their format, and then are relative to it. Splats and meshes that lie
    nearer to the origin than to 0 have not.
    """
    origin = next((start for _, scene in scenes if (start := origin_of(scene)).any()), no_origin())
    moved = []
    for name, scene in scenes:
        kept = not origin.any() or has_origin(scene, origin)
        if not kept:
            steps.say(f"{name}: has no origin; it is taken as relative to {origin_text(origin)}")
        moved.append(scene.relative_to(origin) if kept and isinstance(scene, Splats | Meshes) else scene)
    return moved


def orbit_psnr(a: Any, b: Any, frames: int, edge: int, render: Renderer = KERNELS) -> float:
    """Return the mean PSNR in dB between pictures of two scenes, `edge` pixels wide and high, on an orbit around a.

    render: renders fields and splats.
    """
    views = orbit_cameras(a, frames=frames, width=edge, height=edge)
    return float(compare_scenes(a, b, views, keep_pictures=False, render=render).means["a_b"]["psnr"])


def picture_views(
    scene: RadianceField | Splats | Stage1, cameras: Cameras, samples: int, render: Renderer = KERNELS
) -> Views:
    """Render pictures of a scene, with alpha, to which something else is fitted, or with which it is compared.

    render: renders fields and splats.
    """

    def pictures() -> Iterator[Any]:
        views = progress.each(cameras.cameras)
        images: Iterator[Image]
        if isinstance(scene, Stage1):
            images = (render_stage1(scene, camera, background=None, samples=samples) for camera in views)
        else:
            images = render.each(scene, views, background=None, samples=samples)
        yield from (image.pixels for image in images)

    return build_views(cameras, pictures())


def page_views(
    steps: Steps,
    scene: Any,
    cameras: str | None,
    held_out: Cameras | None = None,
    *,
    name: str,
    origin: Floats | None = None,
) -> tuple[Cameras, Camera]:
    """Return the cameras of a page, from views_of(), and the camera of its cover picture.

    held_out: the cameras without a capture; None: an orbit. The cover is square: it shows what the first camera sees
    along its shorter edge. origin: as in views_of().
    """
    if cameras is None and held_out is not None:
        views = held_out
    else:
        views = views_of(steps, scene, cameras, name=name, frames=1, edge=COVER, origin=origin)
    first = views.cameras[0]
    focal = first.fx * COVER / min(first.width, first.height)
    with io.blame(cameras or name):
        return views, Camera(COVER, COVER, focal, first.pose, first.name)
