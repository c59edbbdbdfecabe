"""Light from all directions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from nerfbake.errors import InvalidScene, Problem
from nerfbake.scene.base import Scene, number_problems

_MOST = 1e30  # radiance: sums over a map stay finite


@dataclass(frozen=True, eq=False, repr=False)
class EnvironmentMap(Scene):
    """The light that comes from far away, as an equirectangular map. z is up.

    radiance  (H, 2 H, 3) float32, linear, 0 or more; row 0 is +z, the middle of a row is +x, and the quarter of a row
              to the left of the middle is +y, as in Blender's environment textures

    >>> import numpy as np
    >>> from nerfbake import EnvironmentMap
    >>> print(EnvironmentMap(np.ones((4, 8, 3), np.float32)))
    environment map of 8x4 pixels
    """

    radiance: npt.NDArray[np.float32]

    def __post_init__(self) -> None:
        shape = self.radiance.shape
        sound = len(shape) == 3 and shape[1:] == (2 * shape[0], 3) and shape[0] > 0
        if not sound or self.radiance.dtype != np.float32:
            found = f"has shape {shape}, dtype {self.radiance.dtype}"
            raise InvalidScene(Problem("the environment map", found, "(H, 2 H, 3) float32: twice as wide as high"))
        problems = number_problems("the environment map", self.radiance, most=_MOST)
        if problems:
            raise InvalidScene(problems[0])
        if (self.radiance < 0).any():
            raise InvalidScene(Problem("the environment map", "has values below 0", "radiance, 0 or more"))

    def require_light(self) -> None:
        """Raise InvalidScene if the map is black."""
        if not (self.radiance > 0).any():
            raise InvalidScene(Problem("the environment map", "is black", "some light"))

    def __str__(self) -> str:
        H, W, _ = self.radiance.shape
        return f"environment map of {W:,}x{H:,} pixels"
