"""Write synthetic scenes, to try nerfbake without a download."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from nerfbake import io
from nerfbake.errors import UsageError
from nerfbake.jobs.files import AnyTarget, FolderTarget, as_target
from nerfbake.jobs.steps import SILENT, Steps
from nerfbake.scene.camera import Camera, Cameras
from nerfbake.scene.image import Image
from nerfbake.scene.n3tree import N3Tree
from nerfbake.scene.stage1 import Stage1
from nerfbake.stages.field_to_image import render_field
from nerfbake.stages.objects_to_image import OBJECTS, orbit_object, render_object
from nerfbake.stages.scene_to_cameras import scatter_cameras
from nerfbake.stages.scene_to_field import build_field
from nerfbake.stages.shapes_to_image import orbit_room, render_room
from nerfbake.stages.shapes_to_n3tree import sample_n3tree
from nerfbake.stages.shapes_to_stage1 import sample_stage1


def write_sample_n3tree(
    target: AnyTarget, *, resolution: int = 128, basis: str = "SH9", seed: int = 0, steps: Steps = SILENT
) -> N3Tree:
    """Write a PlenOctree of shiny shapes and return it. This is `nerfbake sample octree`.

    Reads nothing and writes `target`. The options are those of sample_n3tree(). Raises NerfbakeError.

    >>> write_sample_n3tree("small.npz", resolution=16).resolution
    16
    """
    target = as_target(target)
    target.require("N3Tree")
    with steps.phase("building the tree"):
        tree = sample_n3tree(resolution=resolution, basis=basis, seed=seed)
    target.write(steps, tree)
    return tree


def write_sample_stage1(
    target: FolderTarget | str | Path, *, resolution: int = 512, seed: int = 0, steps: Steps = SILENT
) -> Stage1:
    """Write a stage-1 folder of nerf2mesh with a glossy torus and return it. This is `nerfbake sample nerf2mesh`.

    Reads nothing and writes the folder `target`. The options are those of sample_stage1(). Raises NerfbakeError.

    >>> len(write_sample_stage1("torus", resolution=64).fields)
    1
    """
    target = target if isinstance(target, FolderTarget) else FolderTarget(str(target))
    target.require("Stage1")
    with steps.phase("fitting the MLP"):
        scene = sample_stage1(resolution=resolution, seed=seed)
    sizes = target.write(steps, scene)
    steps.say(f"{target.path}: {scene}, {sum(sizes.values()):,} bytes")
    return scene


CAMERAS, ZOOM = "transforms.json", 1.2
SHAPES = "shapes"  # the scene of sample_n3tree()
SAMPLES = 2  # rays along each edge of a pixel: the pixels of photographs are averages


def write_sample_capture(
    folder: str | Path,
    *,
    frames: int = 24,
    edge: int = 200,
    room: bool = False,
    object: str = SHAPES,
    seed: int = 0,
    force: bool = False,
    steps: Steps = SILENT,
) -> Cameras:
    """Write photographs of a synthetic scene and return their cameras. This is `nerfbake sample capture`.

    Reads nothing. Writes NNNN.png, edge x edge pixels of 2 x 2 rays each, and transforms.json to `folder`: shiny shapes
    from all sides, with alpha. object: instead an object of render_object(). room: instead a table in a textured room
    from an arc around it, without alpha. seed: as in sample_n3tree(), orbit_object() or render_room(). force: replace
    existing files. Raises NerfbakeError.

    >>> print(write_sample_capture("capture", frames=3, edge=32))
    3 cameras
    """
    if str(folder) == io.STREAM:
        raise UsageError("stdout takes one file; allowed: a folder")
    folder = Path(folder)
    paths = [folder / f"{i:04d}.png" for i in range(frames)]
    io.require_room([str(path) for path in (*paths, folder / CAMERAS)], force=force)
    if object not in (SHAPES, *OBJECTS):
        raise UsageError(f"`object` is {object!r}; allowed: {', '.join((SHAPES, *OBJECTS))}")
    if room and object != SHAPES:
        raise UsageError(f"`object` {object} and `room` are two scenes; allowed: one of them")
    if room:
        cameras, render = _room(frames, edge, seed)
    elif object == SHAPES:
        cameras, render = _shapes(frames, edge, seed, steps)
    else:
        cameras, render = _object(object, frames, edge, seed)
    for path, camera in zip(paths, cameras.cameras, strict=True):
        with steps.phase(f"rendering {camera.name}"):
            image = render(camera)
        io.save(path, image, force=force, parents=True)
    io.save(folder / CAMERAS, cameras, force=force)
    steps.say(f"{folder}: {cameras} and their photographs, {edge}x{edge} pixels")
    return cameras


def _shapes(frames: int, edge: int, seed: int, steps: Steps) -> tuple[Cameras, Callable[[Camera], Image]]:
    with steps.phase("building the tree"):
        field = build_field(sample_n3tree(seed=seed))
        cameras = scatter_cameras(field, frames=frames, edge=edge, zoom=ZOOM).chosen(samples=SAMPLES)
    return cameras, lambda camera: render_field(field, camera, background=None, samples=SAMPLES)


def _room(frames: int, edge: int, seed: int) -> tuple[Cameras, Callable[[Camera], Image]]:
    cameras = orbit_room(frames=frames, width=edge, height=edge).chosen(samples=SAMPLES)
    return cameras, lambda camera: render_room(camera, seed=seed, samples=SAMPLES)


def _object(name: str, frames: int, edge: int, seed: int) -> tuple[Cameras, Callable[[Camera], Image]]:
    cameras = orbit_object(frames=frames, edge=edge, seed=seed).chosen(samples=SAMPLES)
    return cameras, lambda camera: render_object(name, camera, samples=SAMPLES)
