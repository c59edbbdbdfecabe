"""A pinhole camera in OpenGL's axes: x to the right, y up, looking down -z; pixel centres at halves."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from nerfbake import memory
from nerfbake.errors import InvalidScene, Problem
from nerfbake.scene.base import Scene

MAX_EDGE = 16384  # pixels
WORLD = np.eye(3)
PICTURE_BYTES = 72  # a pixel of a picture that is kept, put into a sheet, and made into bytes (72 measured)


@dataclass(frozen=True, eq=False)
class Camera:
    """width, height and focal in pixels; pose (4, 4) float64 is camera to world; name is the frame's."""

    width: int
    height: int
    focal: float
    pose: npt.NDArray[np.float64]
    name: str = ""

    def __post_init__(self) -> None:
        if not (1 <= self.width <= MAX_EDGE and 1 <= self.height <= MAX_EDGE):
            raise InvalidScene(
                Problem("camera", f"has {self.width}x{self.height} pixels", f"1 to {MAX_EDGE:,} an edge")
            )
        if not (np.isfinite(self.focal) and self.focal > 0):
            raise InvalidScene(Problem("camera", f"has focal length {self.focal:g}", "a finite number above 0"))
        if self.pose.shape != (4, 4) or not np.isfinite(self.pose).all():
            found = f"has a pose of shape {self.pose.shape}" if self.pose.shape != (4, 4) else "has a pose with NaN"
            raise InvalidScene(Problem("camera", found, "4 x 4 finite numbers"))
        if not abs(np.linalg.det(self.pose[:3, :3])) > 1e-12:
            raise InvalidScene(Problem("camera", "has a singular pose", "an invertible rotation"))

    def resized(self, width: int, height: int) -> Camera:
        """The same view in another number of pixels: the field of view across stays."""
        return replace(self, width=width, height=height, focal=self.focal * width / self.width)

    def rays(self) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
        """The camera's place (3,) and a unit direction for each pixel (height * width, 3), rows from the top."""
        right, up, back = self.pose[:3, :3].T
        x = (np.arange(self.width) + 0.5 - self.width / 2) / self.focal
        y = -(np.arange(self.height) + 0.5 - self.height / 2) / self.focal
        directions = (x[:, None] * right - back) + (y[:, None] * up)[:, None]
        directions /= np.sqrt(np.einsum("yxc,yxc->yx", directions, directions))[..., None]
        return self.pose[:3, 3], directions.reshape(-1, 3)


@dataclass(frozen=True, eq=False)
class Cameras(Scene):
    """The cameras of a capture, in order."""

    cameras: tuple[Camera, ...]

    def __post_init__(self) -> None:
        if not self.cameras:
            raise InvalidScene(Problem("frames", "are none", "at least one camera"))

    def __str__(self) -> str:
        return f"{len(self.cameras)} cameras"

    def require_memory(self, *, pictures: int = 1) -> None:
        """Raises MemoryLimit if so many pictures of every camera do not fit all at once."""
        need = PICTURE_BYTES * pictures * sum(camera.width * camera.height for camera in self.cameras)
        memory.require(f"keeping {pictures * len(self.cameras):,} pictures at once", need)


def look_at(
    centre: npt.NDArray[np.float64],
    azimuth: float,
    elevation: float,
    distance: float,
    axes: npt.NDArray[np.float64] = WORLD,
) -> npt.NDArray[np.float64]:
    """(4, 4) pose that looks at a point from so far away; angles in radians, in these axes (rows; the third is up)."""
    away = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
    right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
    pose = np.eye(4)
    pose[:3, :3] = axes.T @ np.stack([right, np.cross(away, right), away], axis=1)
    pose[:3, 3] = centre + distance * (away @ axes)
    return pose
