"""Synthetic scenes as files, to try things out without a download."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import nerfbake
from nerfbake import io
from nerfbake.errors import UsageError
from nerfbake.jobs.files import AnyTarget, FolderTarget, as_target
from nerfbake.jobs.steps import SILENT, Steps


def write_sample_n3tree(target: AnyTarget, *, steps: Steps = SILENT, **options: Any) -> nerfbake.N3Tree:
    """Writes a PlenOctree of shiny shapes, and gives it; `nerfbake sample octree`.

    Reads nothing, writes `target`. Options go to sample_n3tree(). Raises NerfbakeError.

    >>> write_sample_n3tree("small.npz", resolution=16).resolution
    16
    """
    target = as_target(target)
    target.require("N3Tree")
    with steps.phase("growing the tree"):
        tree = nerfbake.sample_n3tree(**options)
    target.write(steps, tree)
    return tree


def write_sample_stage1(target: FolderTarget | str | Path, *, steps: Steps = SILENT, **options: Any) -> nerfbake.Stage1:
    """Writes a stage-1 folder of nerf2mesh with a glossy torus, and gives it; `nerfbake sample nerf2mesh`.

    Reads nothing, writes the folder `target`. Options go to sample_stage1(). Raises NerfbakeError.

    >>> len(write_sample_stage1("torus", resolution=64).fields)
    1
    """
    target = target if isinstance(target, FolderTarget) else FolderTarget(str(target))
    target.require()
    with steps.phase("fitting the MLP"):
        scene = nerfbake.sample_stage1(**options)
    sizes = target.write(steps, scene)
    steps.say(f"{target.path}: {scene}, {sum(sizes.values()):,} bytes")
    return scene


CAMERAS, ZOOM = "transforms.json", 1.2
SAMPLES = 2  # rays along each edge of a pixel: photographs are averages


def write_sample_capture(
    folder: str | Path,
    *,
    frames: int = 24,
    edge: int = 200,
    seed: int = 0,
    force: bool = False,
    steps: Steps = SILENT,
) -> nerfbake.Cameras:
    """Writes photographs of shiny shapes from all sides, gives their cameras; `nerfbake sample capture`.

    Reads nothing, writes NNNN.png with alpha, edge x edge pixels of 2 x 2 rays each, and transforms.json into `folder`.
    seed: as sample_n3tree() takes it. force: replace files that are there. Raises NerfbakeError.

    >>> print(write_sample_capture("capture", frames=3, edge=32))
    3 cameras
    """
    if str(folder) == io.STREAM:
        raise UsageError("stdout takes one file; allowed: a folder")
    folder = Path(folder)
    paths = [folder / f"{i:04d}.png" for i in range(frames)]
    io.require_room([str(path) for path in (*paths, folder / CAMERAS)], force=force)
    with steps.phase("growing the tree"):
        field = nerfbake.build_field(nerfbake.sample_n3tree(seed=seed))
        cameras = nerfbake.sphere_cameras(field, frames=frames, edge=edge, zoom=ZOOM).chosen(samples=SAMPLES)
    for path, camera in zip(paths, cameras.cameras, strict=True):
        with steps.phase(f"rendering {camera.name}"):
            image = nerfbake.render_field(field, camera, background=None, samples=SAMPLES)
        io.save(path, image, force=force, parents=True)
    io.save(folder / CAMERAS, cameras, force=force)
    steps.say(f"{folder}: {cameras} and their photographs, {edge}x{edge} pixels")
    return cameras
