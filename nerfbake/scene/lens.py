"""What a lens does to a picture beside perspective: the polynomial models that structure from motion fits."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake.errors import InvalidScene, Problem
from nerfbake.kernels.march import lens
from nerfbake.kernels.maths.elementary import sine_cosine

LensModel = Literal["polynomial", "rational", "fisheye"]
MOST = 1e6  # of a coefficient
_COUNT = {"polynomial": 4, "rational": 6, "fisheye": 4}


@dataclass(frozen=True)
class Lens:
    """Distortion on the plane one unit before the camera; kernels.march.lens has the formulas.

    polynomial  k1 r^2 + k2 r^4 + k3 r^6 + k4 r^8, and p1, p2: OpenCV's and COLMAP's models up to k3, nerfstudio's all
    rational    (1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 + k5 r^4 + k6 r^6), and p1, p2: COLMAP's FULL_OPENCV
    fisheye     the angle from the axis is seen at theta (1 + k1 theta^2 + ... + k4 theta^8): OpenCV's fisheye module
    """

    model: LensModel
    k: tuple[float, ...] = ()
    p: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        while self.k and self.k[-1] == 0:  # one way to say one thing
            object.__setattr__(self, "k", self.k[:-1])
        if len(self.k) > _COUNT[self.model]:
            found = f"has {len(self.k)} coefficients"
            raise InvalidScene(Problem(f"the {self.model} lens", found, f"{_COUNT[self.model]} at most"))
        for name, values in (("k", self.k), ("p", self.p)):
            for i, value in enumerate(values, start=1):
                if not abs(value) <= MOST:
                    raise InvalidScene(Problem(f"{name}{i}", f"is {value:g}", f"-{MOST:g} to {MOST:g}"))
        if self.model == "fisheye" and any(self.p):
            raise InvalidScene(Problem("p1, p2", "are those of a fisheye lens", "0 there"))

    @property
    def bends(self) -> bool:
        """False if it shows what a pinhole does."""
        return self.model == "fisheye" or any(self.k) or any(self.p)

    def looks(self, points: npt.NDArray[np.float64]) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.bool_]]:
        """Where to look to see these points (m, 2): (m, 3) unit vectors, x right, y down, z ahead; and which exist."""
        most = np.pi if self.model == "fisheye" else np.inf
        plane, fine = lens.undistort(points, *self._coefficients, self.p, most=most)
        plane[~fine] = 0
        r = np.sqrt((plane * plane).sum(axis=1))
        looks = np.empty((len(plane), 3))
        if self.model == "fisheye":
            sine, looks[:, 2] = sine_cosine(r)
            looks[:, :2] = plane * np.divide(sine, r, out=np.ones_like(r), where=r > 0)[:, None]
        else:
            ahead = 1 / np.sqrt(1 + r * r)
            looks[:, :2] = plane * ahead[:, None]
            looks[:, 2] = ahead
        return looks, fine

    @property
    def _coefficients(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        return (self.k[:3], self.k[3:]) if self.model == "rational" else (self.k, ())


class Raster(NamedTuple):
    """Where a picture's pixels are on the plane before the camera, but for the lens."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float

    def points(self, columns: npt.NDArray[np.int64], rows: npt.NDArray[np.int64]) -> npt.NDArray[np.float64]:
        """(..., 2) of these pixels' centres, x right, y down."""
        x, y = (columns + 0.5 - self.cx) / self.fx, (rows + 0.5 - self.cy) / self.fy
        return np.stack(np.broadcast_arrays(x, y), axis=-1)


@lru_cache(maxsize=1)  # the frames of a capture share it: the search takes as long as a small picture
def pixel_looks(raster: Raster, lens: Lens) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.bool_]]:
    """(H, W, 3) where pixels' centres look through a lens, x right, y down, z ahead; (H W,) whether they see."""
    points = raster.points(np.arange(raster.width), np.arange(raster.height)[:, None])
    looks, fine = lens.looks(points.reshape(-1, 2))
    return looks.reshape(*points.shape[:2], 3), fine


@lru_cache(maxsize=64)
def blind_rim(raster: Raster, lens: Lens) -> int | None:
    """The first pixel of the picture's rim that sees nothing, if there is one."""
    x, y = np.arange(raster.width), np.arange(raster.height)
    columns = np.concatenate([x, x, np.zeros_like(y), np.full_like(y, raster.width - 1)])
    rows = np.concatenate([np.zeros_like(x), np.full_like(x, raster.height - 1), y, y])
    _, fine = lens.looks(raster.points(columns, rows))
    return None if fine.all() else int((rows * raster.width + columns)[~fine].min())
