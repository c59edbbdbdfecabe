"""What is known of the world of cameras: its unit, its vertical axis, and where on Earth its origin is."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from nerfbake.kernels.arrays import Floats
from nerfbake.kernels.maths.affine import compose, transform_points

UP = np.array([0.0, 0.0, 1.0])


class EarthPlace(NamedTuple):
    """A point on Earth: latitude and longitude in degrees (WGS 84), altitude in metres."""

    latitude: float
    longitude: float
    altitude: float

    def __str__(self) -> str:
        return f"{self.latitude:.7f}, {self.longitude:.7f}, {self.altitude:.2f} m"


class World(NamedTuple):
    """metres: the unit is a metre. upright: z points up. place: of the origin, where x points east and y north."""

    metres: bool = False
    upright: bool = False
    place: EarthPlace | None = None

    def __str__(self) -> str:
        parts = ["metres"] * self.metres + ["z up"] * self.upright
        if self.place is not None:
            parts += [f"x east, its origin at {self.place}"]
        return ", ".join(parts)


UNKNOWN = World()
_TURN, _SHIFT = np.eye(3), np.zeros(3)


class Frame(NamedTuple):
    """Another world: X' = scale turn X + shift, with a rotation (3, 3) and a translation (3,)."""

    scale: float = 1.0
    turn: Floats = _TURN
    shift: Floats = _SHIFT

    @property
    def matrix(self) -> Floats:
        """(3, 4), as Cameras.transformed() takes it."""
        return np.column_stack([self.scale * self.turn, self.shift])

    def then(self, other: Frame) -> Frame:
        """This frame, and then the other one."""
        shift = transform_points(self.shift, other.matrix)
        return Frame(other.scale * self.scale, compose(other.turn, self.turn), shift)

    def listed(self) -> dict[str, Any]:
        """The fields as numbers and lists."""
        return {"scale": self.scale, "turn": self.turn.tolist(), "shift": self.shift.tolist()}
