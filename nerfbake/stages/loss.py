"""The loss in dB that a change of a scene causes in its pictures: measured against photographs, or predicted."""

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
from nerfbake.stages.renderers import KERNELS, Renderer
from nerfbake.stages.scene_to_cameras import scatter_cameras, without_strays

_LN_10 = 2.302585092994046
# These positions differ from those of the cameras that importance is computed from. The zoom is a little above 1: the
# real chair covers a little more of these pictures (0.24) than of its photographs (0.20), on which M is measured.
_FRAMES, _EDGE, _ZOOM = 24, 144, 1.13
# A predicted loss is that of MARGIN times the squared error. The losses measured on the calibration scenes of
# docs/compression.md are those of up to 1.87 times. The margin is almost twice as large, because the original's own
# error can be correlated with that of rounding: on another scene, their covariance doubled what rounding added.
MARGIN = 3.5
SOURCE_PSNR = 30.5  # dB: the original's PSNR if it is unknown

Pixels = npt.NDArray[np.float64]


class Loss(NamedTuple):
    """error: mean squared difference from the original's pictures; loss: PSNR lost against the photographs, in dB.

    A predicted loss is an upper bound.
    """

    error: float
    loss: float


@dataclass(frozen=True, eq=False)
class LossMeter:
    """Measures or predicts the loss of a changed field.

    cameras      the cameras of each picture; the picture is the mean over these, each with one ray of every pixel
    references   the original's pictures
    truth        the photographs; None: there are none, and the loss is predicted
    source_psnr  PSNR of the original against the photographs, in dB
    """

    cameras: list[list[Camera]]
    references: list[Pixels]
    truth: list[Pixels] | None
    source_psnr: float
    views: int  # number of photographs, or of camera positions around the scene
    background: tuple[float, float, float] = WHITE
    render: Renderer = KERNELS  # of fields

    @property
    def source_error(self) -> float:
        """M: the mean squared error of the original against the photographs that it was trained on."""
        return float(exp(-self.source_psnr * _LN_10 / 10))

    @property
    def margin(self) -> float:
        """The factor of the squared error in the loss."""
        return MARGIN if self.truth is None else 1.0

    def allowed_error(self, loss: float) -> float:
        """Return the mean squared difference m for which this loss is predicted, or, if it is measured, expected."""
        return self.source_error * (float(exp(loss * _LN_10 / 10)) - 1) / self.margin

    def expected_loss(self, error: float) -> float:
        """Return the loss in dB if this error were independent of the original's own."""
        return 10 / _LN_10 * float(log(1 + error / self.source_error))

    def cost(self, field: RadianceField) -> Loss:
        """Render the field, and return its loss."""
        pictures = [_picture(field, camera, self.background, self.render) for camera in progress.each(self.cameras)]
        pairs = zip(pictures, self.references, strict=True)
        squares = sum(float(np.square(picture - reference).sum()) for picture, reference in pairs)
        error = squares / sum(reference.size for reference in self.references)
        if self.truth is None:
            return Loss(error, self.expected_loss(self.margin * error))
        return Loss(error, self.source_psnr - _mean_psnr(pictures, self.truth))


def predicting_judge(
    field: RadianceField, *, source_psnr: float = SOURCE_PSNR, render: Renderer = KERNELS
) -> LossMeter:
    """Return a meter that predicts at most how much is lost: docs/compression.md, "Without photographs"."""
    cameras = scatter_cameras(without_strays(field), frames=_FRAMES, edge=_EDGE, zoom=_ZOOM)
    looks = [[camera] for camera in cameras.cameras]
    _require_memory(looks, 1)
    references = [_picture(field, camera, WHITE, render) for camera in progress.each(looks)]
    return LossMeter(looks, references, None, source_psnr, len(references), render=render)


def measuring_judge(field: RadianceField, held_out: HeldOut, *, render: Renderer = KERNELS) -> LossMeter:
    """Return a meter that measures the loss on pixels of photographs.

    Raises MemoryLimit, and InvalidScene for lenses that do not cover the corners of their pictures.
    """
    held_out.cameras.require_covered()
    looks, background = held_out.looks(), held_out.background
    _require_memory(looks, 2)
    truth = [pixels / 255 for pixels in held_out.pixels]
    references = [_picture(field, each, background, render) for each in looks]
    return LossMeter(looks, references, truth, _mean_psnr(references, truth), len(looks), background, render)


def _require_memory(looks: list[list[Camera]], kept: int) -> None:
    pixels = sum(camera.width * camera.height for camera, *_ in looks)
    memory.require("the pictures that the loss is measured on", pixels * 24 * (kept + 1))


def _picture(
    field: RadianceField, cameras: list[Camera], background: tuple[float, float, float], render: Renderer
) -> Pixels:
    pictures = render.each(field, cameras, background=background)
    first, *others = (picture.colour.astype(np.float64) for picture in pictures)
    for other in others:
        first += other
    return first / len(cameras)


def _mean_psnr(pictures: list[Pixels], others: list[Pixels]) -> float:
    return sum(psnr(a, b) for a, b in zip(pictures, others, strict=True)) / len(pictures)
