"""How far away things are in a picture."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from nerfbake import memory
from nerfbake.errors import InvalidScene, Problem
from nerfbake.kernels.soundness import MAX_EDGE, count_problem
from nerfbake.scene.base import MAX_WORLD, Scene, number_problems


@dataclass(frozen=True, eq=False, repr=False)
class Depth(Scene):
    """distance (H, W) float32: along each pixel's ray, in world units; 0 where it meets nothing.

    >>> import numpy as np
    >>> from nerfbake import Depth
    >>> print(Depth(np.array([[0.0, 1.5, 2.5]], np.float32)))
    depth of 3x1, 1.5 to 2.5 world units
    """

    distance: npt.NDArray[np.float32]

    def __post_init__(self) -> None:
        shape = self.distance.shape
        if len(shape) != 2 or self.distance.dtype != np.float32 or not all(1 <= edge <= MAX_EDGE for edge in shape):
            found = f"has shape {shape}, dtype {self.distance.dtype}"
            raise InvalidScene(Problem("depth", found, f"(H, W) float32, 1 to {MAX_EDGE:,} pixels an edge"))
        memory.require("depth", self.distance.size)
        for problem in number_problems("depth", self.distance, most=MAX_WORLD):
            raise InvalidScene(problem)
        for problem in count_problem("depth", self.distance < 0, self.distance, "a distance from 0"):
            raise InvalidScene(problem)

    def __str__(self) -> str:
        met = self.distance[self.distance > 0]
        reach = f", {met.min():.4g} to {met.max():.4g} world units" if len(met) else ", nothing met"
        return f"depth of {self.distance.shape[1]}x{self.distance.shape[0]}{reach}"
