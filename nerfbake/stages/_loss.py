"""What a change of a scene costs in its pictures, in dB: measured against photographs, or predicted."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake import memory, progress
from nerfbake.kernels.maths.elementary import exp, log
from nerfbake.kernels.picture.metrics import psnr
from nerfbake.scene.camera import Camera
from nerfbake.scene.held_out import HeldOut
from nerfbake.scene.image import WHITE
from nerfbake.scene.radiance_field import RadianceField
from nerfbake.stages.field_to_image import render_field
from nerfbake.stages.scene_to_cameras import sphere_cameras, without_strays

_LN_10 = 2.302585092994046
# Other places than those that importance is collected from; seen a little larger than where all is framed, so that the
# real chair covers a little more of the pictures (0.24) than of its photographs (0.20), on which M is measured.
_FRAMES, _EDGE, _ZOOM = 24, 144, 1.13

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
    background: tuple[float, float, float] = WHITE

    @property
    def source_error(self) -> float:
        """M: the mean squared error of the original against the photographs that it was made from."""
        return float(exp(-self.source_psnr * _LN_10 / 10))

    def allowed_error(self, loss: float) -> float:
        """The m whose predicted loss this is."""
        return self.source_error * (float(exp(loss * _LN_10 / 10)) - 1)

    def cost(self, field: RadianceField) -> Cost:
        pictures = [_picture(field, camera, self.background) for camera in progress.each(self.cameras)]
        pairs = zip(pictures, self.references, strict=True)
        squares = sum(float(np.square(picture - reference).sum()) for picture, reference in pairs)
        error = squares / sum(reference.size for reference in self.references)
        if self.truth is None:
            return Cost(error, 10 / _LN_10 * float(log(1 + error / self.source_error)))
        return Cost(error, self.source_psnr - _mean_psnr(pictures, self.truth))


def predicting_judge(field: RadianceField, *, source_psnr: float) -> Judge:
    """Predicts by 10 log10(1 + m / M), as if errors were independent of those that the original makes itself."""
    cameras = sphere_cameras(without_strays(field), frames=_FRAMES, edge=_EDGE, zoom=_ZOOM)
    looks = [[camera] for camera in cameras.cameras]
    _require_memory(looks, 1)
    references = [_picture(field, camera, WHITE) for camera in progress.each(looks)]
    return Judge(looks, references, None, source_psnr, len(references))


def measuring_judge(field: RadianceField, held_out: HeldOut) -> Judge:
    """Measures on pixels of photographs. Raises MemoryLimit, InvalidScene for lenses that miss a corner."""
    held_out.cameras.require_covered()
    looks, background = held_out.looks(), held_out.background
    _require_memory(looks, 2)
    truth = [pixels / 255 for pixels in held_out.pixels]
    references = [_picture(field, each, background) for each in looks]
    return Judge(looks, references, truth, _mean_psnr(references, truth), len(looks), background)


def _require_memory(looks: list[list[Camera]], kept: int) -> None:
    pixels = sum(camera.width * camera.height for camera, *_ in looks)
    memory.require("the pictures that judge", pixels * 24 * (kept + 1))


def _picture(field: RadianceField, cameras: list[Camera], background: tuple[float, float, float]) -> Pixels:
    pictures = (render_field(field, camera, background=background) for camera in cameras)
    first, *others = (picture.colour.astype(np.float64) for picture in pictures)
    for other in others:
        first += other
    return first / len(cameras)


def _mean_psnr(pictures: list[Pixels], others: list[Pixels]) -> float:
    return sum(psnr(a, b) for a, b in zip(pictures, others, strict=True)) / len(pictures)
