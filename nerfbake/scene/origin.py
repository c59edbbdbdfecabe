"""The origin of a scene far from 0: coordinates of a map in float64, to which its float32 positions are relative.

At 5,012,345 (metres north, in UTM) float32 has steps of half a metre. The rule for splats and meshes, in one place:
a file gets an origin if float32 would change its coordinates, and if it is farther from 0 than FAR times its extent.
The extent is that of the middle 98 % of the points, the origin their middle, rounded to a power of ten of that extent.
All other files have the origin 0, and positions as before.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from nerfbake.errors import InvalidScene, Problem
from nerfbake.kernels.arrays import Floats
from nerfbake.kernels.maths.elementary import cast
from nerfbake.scene.base import MAX_WORLD

FAR = 64  # extents; float32 then resolves a 2^18th of the extent
MAP = 10_000  # units: coordinates of maps are farther from 0
_STRAYS = 0.01  # of the points at each end of an axis, which do not count
_LEAST = 2.0**-20  # of the distance from 0: extent of a scene that is one point


def no_origin() -> Floats:
    return np.zeros(3)


def require_origin(origin: Floats) -> None:
    """Raise InvalidScene unless this is (3,) float64, finite, and not too far."""
    if origin.shape != (3,) or origin.dtype != np.float64:
        raise InvalidScene(Problem("origin", f"has shape {origin.shape}, dtype {origin.dtype}", "(3,) float64"))
    if not (np.abs(origin) <= MAX_WORLD).all():
        raise InvalidScene(Problem("origin", f"is {origin_text(origin)}", f"finite numbers, up to {MAX_WORLD:g}"))


def choose_origin(parts: Sequence[npt.NDArray[Any]]) -> Floats:
    """Return the origin (3,) of a scene by the rule above. parts: all its points, (n, 3) floats each."""
    if all(part.dtype.kind != "f" or part.dtype.itemsize <= 4 or _fits(part) for part in parts):
        return no_origin()
    points = np.concatenate([cast(part, np.float64) for part in parts])
    points = points[(np.abs(points) <= MAX_WORLD).all(axis=1)]
    if not len(points):
        return no_origin()
    strays = int(_STRAYS * len(points))
    ordered = np.partition(points, (strays, len(points) - 1 - strays), axis=0)
    low, high = ordered[strays], ordered[-1 - strays]
    middle, extent = (low + high) / 2, float((high - low).max())
    distance = float(np.abs(middle).max())
    if distance <= FAR * (extent or 1.0):  # a single point has no extent
        return no_origin()
    exponent = int(f"{max(extent, distance * _LEAST):e}".partition("e")[2])
    return np.array([round(float(value), -exponent) for value in middle]) + 0.0  # no negative zeros


def choose_origin_of_cameras(eyes: Floats) -> Floats:
    """Return the origin (3,) of a capture by the positions (n, 3) of its cameras: 0 if it is nearer to 0 than MAP.

    Cameras that only turn have no extent, so the rule above alone would move every capture of that kind.
    """
    origin = choose_origin([eyes])
    return origin if float(np.abs(origin).max()) >= MAP else no_origin()


def _fits(points: npt.NDArray[Any]) -> bool:
    """Whether float32 holds these coordinates as they are. Points beyond MAX_WORLD do not count."""
    same = cast(points, np.float32) == points
    return bool((same | ~(np.abs(points) <= MAX_WORLD)).all())


def relative_to(points: npt.NDArray[Any], origin: Floats) -> npt.NDArray[np.float32]:
    """Return points (n, 3) relative to an origin, in float32."""
    if not origin.any():
        return cast(points, np.float32)
    with np.errstate(invalid="ignore"):
        return cast(cast(points, np.float64) - origin, np.float32)


def step_at(origin: Floats) -> float:
    """The distance between neighbouring float32 numbers of the size of these coordinates."""
    return float(np.spacing(np.float32(np.abs(origin).max())))


def origin_text(origin: Floats) -> str:
    return " ".join(f"{value:.15g}" for value in origin.tolist())


def lost_origin(origin: Floats, keeper: str) -> str:
    """The note for an output that has no place for the origin. keeper: what cannot keep it."""
    return f"positions are relative to the origin {origin_text(origin)}, which {keeper} cannot keep"
