"""Points in space that a program found in the pictures of a capture, and where the pictures show them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from nerfbake.errors import InvalidScene, Problem
from nerfbake.kernels.arrays import Floats
from nerfbake.scene.base import MAX_WORLD


def _none(*shape: int) -> npt.NDArray[np.int64]:
    return np.zeros(shape, np.int64)


@dataclass(frozen=True, eq=False)
class SparsePoints:
    """Points (p, 3) float64 in the world of the cameras, and their m observations.

    camera  (m,) int64, the number of the camera that sees a point
    point   (m,) int64, the number of the point
    pixel   (m, 2) float64, where it is in the picture, from the upper left corner

    A file may have points without observations.
    """

    positions: Floats
    camera: npt.NDArray[np.int64] = field(default_factory=lambda: _none(0))
    point: npt.NDArray[np.int64] = field(default_factory=lambda: _none(0))
    pixel: Floats = field(default_factory=lambda: np.zeros((0, 2)))

    def __post_init__(self) -> None:
        shapes = self.positions.shape[1:], self.camera.shape, self.point.shape, self.pixel.shape
        m = len(self.camera)
        if shapes != ((3,), (m,), (m,), (m, 2)):
            raise InvalidScene(Problem("the points", f"have shapes {shapes}", "(3,), (m,), (m,), (m, 2)"))
        if not (np.abs(self.positions) <= MAX_WORLD).all():
            raise InvalidScene(Problem("the points", "hold a number that is not finite", f"up to {MAX_WORLD:g}"))
        if m and not (self.point.min() >= 0 and self.point.max() < len(self.positions)):
            raise InvalidScene(Problem("the points", "are seen that do not exist", f"0 to {len(self.positions) - 1:,}"))

    def __len__(self) -> int:
        return len(self.positions)

    def seen_by(self, numbers: Mapping[int, int]) -> SparsePoints:
        """All points, with the observations of these cameras, which get new numbers."""
        kept = np.isin(self.camera, list(numbers))
        camera = np.array([numbers[i] for i in self.camera[kept].tolist()], np.int64)
        return replace(self, camera=camera, point=self.point[kept], pixel=self.pixel[kept])
