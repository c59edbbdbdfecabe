"""How far away things are in a picture."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from nerfbake.errors import InvalidScene, Problem
from nerfbake.scene.base import Scene


@dataclass(frozen=True, eq=False)
class Depth(Scene):
    """distance (H, W) float32: along each pixel's ray, in world units; 0 where it meets nothing."""

    distance: npt.NDArray[np.float32]

    def __post_init__(self) -> None:
        if self.distance.ndim != 2 or self.distance.dtype != np.float32:
            found = f"has shape {self.distance.shape}, dtype {self.distance.dtype}"
            raise InvalidScene(Problem("depth", found, "(H, W) float32"))
        if not (np.isfinite(self.distance) & (self.distance >= 0)).all():
            raise InvalidScene(Problem("depth", "has distances that are none", "finite numbers from 0"))

    def __str__(self) -> str:
        met = self.distance[self.distance > 0]
        reach = f", {met.min():.4g} to {met.max():.4g} world units" if len(met) else ", nothing met"
        return f"depth of {self.distance.shape[1]}x{self.distance.shape[0]}{reach}"
