"""The lens of a camera: polynomial distortion, as structure from motion fits it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from nerfbake.errors import InvalidScene, Problem
from nerfbake.kernels.march import lens
from nerfbake.kernels.maths.elementary import sine_cosine, tangent

LensModel = Literal[
    "polynomial", "rational", "fisheye", "fov", "division", "eucm", "thin_prism", "prisms", "equirectangular"
]
MOST = 1e6  # largest coefficient
_COUNT = {
    "polynomial": 4,
    "rational": 6,
    "fisheye": 4,
    "fov": 1,
    "division": 1,
    "eucm": 2,
    "thin_prism": 4,
    "prisms": 6,
    "equirectangular": 0,
}
_PRISMS = ("thin_prism", "prisms")  # models with thin prisms
_ANGULAR = ("fisheye", *_PRISMS)  # models of the angle from the axis
_TANGENTIAL = ("polynomial", "rational", *_PRISMS)  # models with p1 and p2
_CLOSED = ("fov", "division", "eucm")  # models whose inverse is a formula


@dataclass(frozen=True)
class Lens:
    """Distortion on the plane at distance 1 in front of the camera; kernels.march.lens has the formulas.

    polynomial  k1 r^2 + k2 r^4 + k3 r^6 + k4 r^8, and p1, p2: OpenCV's and COLMAP's models up to k3, nerfstudio's all
    rational    (1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 + k5 r^4 + k6 r^6), and p1, p2: COLMAP's FULL_OPENCV
    fisheye     the angle theta from the axis appears at theta (1 + k1 theta^2 + ... + k4 theta^8): OpenCV's fisheye
                module
    fov         k1 = omega: a point at the radius r appears at arctan(2 r tan(omega / 2)) / omega: COLMAP's FOV
    division    r' of the picture is r' / (1 + k1 r'^2) on the plane: COLMAP's DIVISION
    eucm        k1 = alpha, k2 = beta: the ray through (x, y) of the picture is (x, y, (1 - beta alpha^2 r^2) /
                (alpha sqrt(1 - (2 alpha - 1) beta r^2) + 1 - alpha)): COLMAP's EUCM
    thin_prism  a fisheye with p1, p2 and thin prisms, which add to it: COLMAP's THIN_PRISM_FISHEYE
    prisms      a fisheye with k1 to k6, which p1, p2 and the prisms then bend: COLMAP's RAD_TAN_THIN_PRISM_FISHEYE
    equirectangular  x is the longitude and y the latitude in radians, to the right and downwards from the axis: the
                focal lengths are width / 2 pi and height / pi for a picture of all directions

    prism (s1, s2, s3, s4): thin prisms add s1 r^2 + s2 r^4 to x, and s3 r^2 + s4 r^4 to y.

    skew is added to the distorted x for each unit of the distorted y: the sensor's axes are not at right angles. It is
    the entry (0, 1) of the matrix of intrinsics divided by fx.
    """

    model: LensModel
    k: tuple[float, ...] = ()
    p: tuple[float, float] = (0.0, 0.0)
    skew: float = 0.0
    prism: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        while self.k and self.k[-1] == 0:  # equal lenses compare equal
            object.__setattr__(self, "k", self.k[:-1])
        if len(self.k) > _COUNT[self.model]:
            found = f"has {len(self.k)} coefficients"
            raise InvalidScene(Problem(f"the {self.model} lens", found, f"{_COUNT[self.model]} at most"))
        for name, values in (("k", self.k), ("p", self.p), ("s", self.prism)):
            for i, value in enumerate(values, start=1):
                if not abs(value) <= MOST:
                    raise InvalidScene(Problem(f"{name}{i}", f"is {value:g}", f"-{MOST:g} to {MOST:g}"))
        if not abs(self.skew) <= 1:
            raise InvalidScene(Problem("the skew", f"is {self.skew:g}", "-1 to 1 times the focal length"))
        if self.model not in _TANGENTIAL and any(self.p):
            raise InvalidScene(Problem("p1, p2", f"are set for a {self.model} lens", "0"))

    @property
    def bends(self) -> bool:
        """False if the lens is equivalent to a pinhole."""
        if self.model in _ANGULAR or self.all_round:
            return True
        return any(self.k) or any(self.p) or self.skew != 0

    @property
    def all_round(self) -> bool:
        """True for pictures of all directions, on which a camera's axis has no special place."""
        return self.model == "equirectangular"

    def looks(self, points: npt.NDArray[np.float64]) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.bool_]]:
        """The viewing directions of points (m, 2) on the plane: (m, 3) unit vectors, x right, y down, z forward.

        Also returns (m,) bool: the points for which a direction exists.
        """
        angular = self.model in _ANGULAR
        most = np.pi if angular else np.inf
        if self.skew:
            points = np.stack([points[:, 0] - self.skew * points[:, 1], points[:, 1]], axis=1)
        if self.model in _CLOSED:
            return self._formula(points)
        if self.all_round:
            return _all_round(points)
        if self.model == "prisms":
            bent, fine = lens.undistort(points, (), (), self.p, self.prism)
            plane, inside = lens.undistort(bent, self.k, (), (0.0, 0.0), most=most)
            fine &= inside
        else:
            plane, fine = lens.undistort(points, *self._coefficients, self.p, self.prism, most=most)
        plane[~fine] = 0
        r = np.sqrt((plane * plane).sum(axis=1))
        looks = np.empty((len(plane), 3))
        if angular:
            sine, looks[:, 2] = sine_cosine(r)
            looks[:, :2] = plane * np.divide(sine, r, out=np.ones_like(r), where=r > 0)[:, None]
        else:
            ahead = 1 / np.sqrt(1 + r * r)
            looks[:, :2] = plane * ahead[:, None]
            looks[:, 2] = ahead
        return looks, fine

    def _formula(self, points: npt.NDArray[np.float64]) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.bool_]]:
        """looks() for a lens of _CLOSED."""
        a, b = (*self.k, 0.0, 0.0)[:2]
        square = (points * points).sum(axis=1)
        looks = np.column_stack([points, np.ones(len(points))])
        with np.errstate(all="ignore"):  # points that no ray reaches are not fine
            if self.model == "fov":
                angle = a * np.sqrt(square)
                fine = np.abs(angle) < np.pi / 2
                grown = tangent(np.where(fine, angle, 0)) / (2 * np.sqrt(square) * tangent(a / 2))
                looks[:, :2] *= np.where((square > 0) & (a != 0), grown, 1)[:, None]
            elif self.model == "division":
                looks[:, 2] = 1 + a * square
                fine = looks[:, 2] > 0
            else:
                under = 1 - (2 * a - 1) * b * square
                below = a * np.sqrt(np.maximum(under, 0)) + 1 - a
                looks[:, 2] = (1 - b * a * a * square) / below
                fine = (under >= 0) & (below > 0)
            looks /= np.sqrt((looks * looks).sum(axis=1))[:, None]
        fine &= np.isfinite(looks).all(axis=1)
        looks[~fine] = 0, 0, 1
        return looks, fine

    @property
    def _coefficients(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        return (self.k[:3], self.k[3:]) if self.model == "rational" else (self.k, ())


def _all_round(points: npt.NDArray[np.float64]) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.bool_]]:
    """The directions (m, 3) of longitudes and latitudes (m, 2), and which of them are on the sphere."""
    fine = np.asarray((np.abs(points) <= np.array([np.pi, np.pi / 2]) * (1 + 1e-9)).all(axis=1))
    (across, ahead), (down, flat) = (sine_cosine(np.where(fine, angle, 0)) for angle in points.T)
    return np.stack([flat * across, down, flat * ahead], axis=1), fine


def all_round(width: float, height: float) -> tuple[tuple[float, float], tuple[float, float], Lens]:
    """Return focal lengths, centre and lens of a picture of all directions with this many pixels."""
    return (width / (2 * np.pi), height / np.pi), (width / 2, height / 2), Lens("equirectangular")
