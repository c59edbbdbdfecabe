"""What a change of a scene costs in its pictures, in dB: measured against photographs, or predicted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake import memory, progress
from nerfbake.errors import InvalidScene, Problem
from nerfbake.kernels.maths.elementary import exp, log
from nerfbake.kernels.picture.metrics import psnr
from nerfbake.scene.camera import Camera, Cameras
from nerfbake.scene.image import WHITE, Image
from nerfbake.scene.radiance_field import RadianceField
from nerfbake.stages.field_to_image import render_field
from nerfbake.stages.scene_to_cameras import sphere_cameras

_LN_10 = 2.302585092994046
_RAYS = 500_000  # are enough to tell 0.1 dB to a hundredth
# Other places than those that importance is collected from; seen a little larger than where all is framed, so that the
# real chair covers as much of the pictures as of its photographs (0.21), on which M is measured.
_FRAMES, _EDGE, _ZOOM = 24, 144, 1.2

Pixels = npt.NDArray[np.float64]


class Cost(NamedTuple):
    """error: the mean squared difference from the original's pictures; loss: dB against photographs."""

    error: float
    loss: float


@dataclass(frozen=True, eq=False)
class Judge:
    """cameras and references, the original's pictures; truth, the photographs, and how near the original comes to them
    in dB, or None where there are none and the loss is predicted for a source of source_psnr.

    A picture is the mean of those of its cameras, each of which has one of the rays of every pixel."""

    cameras: list[list[Camera]]
    references: list[Pixels]
    truth: list[Pixels] | None
    source_psnr: float
    views: int  # how many of the photographs or of the places around the scene

    @property
    def source_error(self) -> float:
        """M: the mean squared error of the original against the photographs that it was made from."""
        return float(exp(-self.source_psnr * _LN_10 / 10))

    def allowed_error(self, loss: float) -> float:
        """The m whose predicted loss this is."""
        return self.source_error * (float(exp(loss * _LN_10 / 10)) - 1)

    def cost(self, field: RadianceField) -> Cost:
        pictures = [_picture(field, camera) for camera in progress.each(self.cameras)]
        pairs = zip(pictures, self.references, strict=True)
        squares = sum(float(np.square(picture - reference).sum()) for picture, reference in pairs)
        error = squares / sum(reference.size for reference in self.references)
        if self.truth is None:
            return Cost(error, 10 / _LN_10 * float(log(1 + error / self.source_error)))
        return Cost(error, self.source_psnr - _mean_psnr(pictures, self.truth))


def predicting_judge(field: RadianceField, *, source_psnr: float) -> Judge:
    """Predicts by 10 log10(1 + m / M), as if errors were independent of those that the original makes itself."""
    cameras = sphere_cameras(field, frames=_FRAMES, edge=_EDGE, zoom=_ZOOM)
    looks = [[camera] for camera in cameras.cameras]
    _require_memory(looks, 1)
    references = [_picture(field, camera) for camera in progress.each(looks)]
    return Judge(looks, references, None, source_psnr, len(references))


def measuring_judge(field: RadianceField, cameras: Cameras, truth: Sequence[Image]) -> Judge:
    """Measures with a photograph for each camera, of which it looks at every k-th pixel each way where there are many,
    and with as many rays a pixel as the cameras say.

    Raises InvalidScene for photographs of another number or size than the cameras', MemoryLimit.
    """
    if len(truth) != len(cameras.cameras):
        raise InvalidScene(Problem("truth", f"has {len(truth)} pictures", f"{len(cameras.cameras)}, one a camera"))
    cameras.require_covered()
    pixels, N = sum(camera.width * camera.height for camera in cameras.cameras), cameras.samples
    every = max(1, int(N * np.sqrt(pixels / _RAYS)))
    looks, photographs = [], []
    for camera, image in zip(cameras.cameras, truth, strict=True):
        if image.size != (camera.width, camera.height):
            found = f"has {image.size[0]}x{image.size[1]} pixels"
            raise InvalidScene(Problem(f"truth of {camera.name}", found, f"{camera.width}x{camera.height}"))
        parts = [(i + 0.5) / N for i in range(N)]
        looks.append([_thinned(camera, every, x, y) for y in parts for x in parts])
        photographs.append(image.over(WHITE).colour[::every, ::every].astype(np.float64))
    _require_memory(looks, 2)
    references = [_picture(field, each) for each in looks]
    decibels = _mean_psnr(references, photographs)
    return Judge(looks, references, photographs, decibels, len(looks))


def _thinned(camera: Camera, every: int, x: float, y: float) -> Camera:
    """The camera of one ray, at x, y in 0..1, of every k-th pixel of every k-th row from the first on: the same rays,
    to the last bits."""
    return replace(
        camera,
        width=-(-camera.width // every),
        height=-(-camera.height // every),
        focal=(camera.fx / every, camera.fy / every),
        centre=(0.5 + (camera.cx - x) / every, 0.5 + (camera.cy - y) / every),
    )


def _require_memory(looks: list[list[Camera]], kept: int) -> None:
    pixels = sum(camera.width * camera.height for camera, *_ in looks)
    memory.require("the pictures that judge", pixels * 24 * (kept + 1))


def _picture(field: RadianceField, cameras: list[Camera]) -> Pixels:
    first, *others = (render_field(field, camera).colour.astype(np.float64) for camera in cameras)
    for other in others:
        first += other
    return first / len(cameras)


def _mean_psnr(pictures: list[Pixels], others: list[Pixels]) -> float:
    return sum(psnr(a, b) for a, b in zip(pictures, others, strict=True)) / len(pictures)
