"""The cameras that a scene is looked at with: those of a capture, or an orbit around the scene."""

from __future__ import annotations

from typing import Any

import nerfbake
from nerfbake import io
from nerfbake.jobs.steps import Steps

COVER = 320  # pixels along an edge of the picture that is there at once in a page


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


def cover_view(camera: nerfbake.Camera) -> nerfbake.Camera:
    """A page's first picture, of the camera's shorter edge."""
    focal = camera.fx * COVER / min(camera.width, camera.height)
    return nerfbake.Camera(COVER, COVER, focal, camera.pose, camera.name)
