"""The cameras that a scene is looked at with: those of a capture, or an orbit around the scene."""

from __future__ import annotations

from typing import Any

import nerfbake
from nerfbake import io
from nerfbake.jobs.steps import Steps


def read_cameras(steps: Steps, path: str) -> nerfbake.Cameras:
    """The cameras of a file or a folder; says which file of a folder it took, and what it took for granted."""
    with steps.phase(f"reading {path}"):
        read = io.load(path, nerfbake.Cameras)
    if read.source:
        steps.say(f"{path}: {read} from {read.source}")
    for note in read.notes:
        steps.say(f"{path}: {note}")
    return read


def shown(steps: Steps, scene: Any, name: str) -> Any:
    """What cameras and pictures are made of: the scene itself, or its field, built once for all of them.

    name: the scene's, for errors.
    """
    # Imported here: commands that show nothing need no stage.
    from nerfbake.stages._picture import Visible, visible

    if isinstance(scene, Visible):
        return scene
    with steps.phase("building the field"), io.blame(name):
        return visible(scene)


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
) -> nerfbake.Cameras:
    """The cameras of a capture; without one those of an orbit of so many frames, `edge` pixels wide and high.

    name: the scene's, for errors. size: (W, H) pixels, samples: rays along each edge of a pixel, where they are to be
    others than the capture's, or than one ray a pixel.
    """
    if cameras is None:
        width, height = size or (edge, edge)
        with steps.phase("framing"), io.blame(name):
            orbit = nerfbake.orbit_cameras(scene, frames=frames, width=width, height=height)
        return orbit.chosen(samples=samples)
    return read_cameras(steps, cameras).chosen(size=size, samples=samples)


def page_views(steps: Steps, scene: Any, cameras: str | None, *, name: str) -> tuple[nerfbake.Cameras, nerfbake.Camera]:
    """Where a page is looked at from, as views_of() has it, and the view of its cover: what the first of the cameras
    sees, of its shorter edge."""
    from nerfbake.scene.page import COVER

    views = views_of(steps, scene, cameras, name=name, frames=1, edge=COVER)
    first = views.cameras[0]
    focal = first.fx * COVER / min(first.width, first.height)
    return views, nerfbake.Camera(COVER, COVER, focal, first.pose, first.name)
