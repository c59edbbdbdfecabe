"""Cameras -> the frame of a world in metres, of one in which z points up, or of one whose ground is z = 0.

Sources: Horn, "Closed-form solution of absolute orientation using unit quaternions" (1987); the least median of squares
of Rousseeuw (1984); WGS 84 for the ellipsoid.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake.errors import InvalidScene, Problem
from nerfbake.kernels.arrays import Floats
from nerfbake.kernels.maths.affine import compose, length, rotate, transform_points
from nerfbake.kernels.maths.elementary import sine_cosine
from nerfbake.kernels.maths.linear import eigenvectors
from nerfbake.kernels.soundness import plural
from nerfbake.scene.camera import Cameras
from nerfbake.scene.world import EarthPlace, Frame

LEAST = 3  # positions, for a similarity
_TRIALS = 300  # samples of three positions or points
_LOOKED_AT = 2000  # positions or points on which a sample is judged
_OUT = 2.5 * 1.4826  # median residuals: those of normal errors are nearer, except 1.2 % of them
_LINE = 3.0  # residuals: cameras that spread less in every second direction stand on a line
_WIDE = 0.02  # of their largest spread: the same, where the positions are rounded alike
_RADIUS, _FLATTENING = 6_378_137.0, 1 / 298.257223563
_THICK = 0.01  # of the size of the scene: distance of a point of the ground from its plane
_STEEP = 0.866  # cosine between the verticals of the ground and of the cameras: 30 degrees
_BELOW = 0.05  # share of the points that may lie below the ground
_LEAST_GROUND = 0.1  # share of the points that lie on the ground
_LEVEL = 0.05  # mean square of the sideways axes along the second vertical: less, and there are two of them
_FEW = 50  # points
_ROUNDS = 5  # of leaving out directions that are wrong
_EQUAL = 1e-3  # radians: directions that are nearer than this are all used
_UPRIGHT = 5.0  # degrees: with more, the pictures were turned, or what they store is not gravity


class Fitted(NamedTuple):
    """A similarity from cameras to known positions.

    residual  the median distance of the moved cameras from these positions, in their unit
    spread    the root of the mean square distance of these positions from their mean
    used      the number of positions that fit
    turned    whether the rotation is determined; if not, because the cameras stand on a line, the frame has none
    """

    frame: Frame
    residual: float
    spread: float
    used: int
    turned: bool


def local_positions(places: Sequence[EarthPlace]) -> tuple[Floats, EarthPlace]:
    """Return (n, 3) metres east, north and up of a reference, and this reference: the medians of the places."""
    middle = EarthPlace(*(float(np.median(values)) for values in zip(*places, strict=True)))
    earth = np.stack([_geocentric(place) for place in places]) - _geocentric(middle)
    (s, c), (t, d) = (sine_cosine(np.radians(angle)) for angle in middle[:2])
    sin_lat, cos_lat, sin_lon, cos_lon = float(s), float(c), float(t), float(d)
    axes = np.array(
        [
            [-sin_lon, cos_lon, 0.0],
            [-sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat],
            [cos_lat * cos_lon, cos_lat * sin_lon, sin_lat],
        ]
    )
    return rotate(earth, axes), middle


def _geocentric(place: EarthPlace) -> Floats:
    (s, c), (t, d) = (sine_cosine(np.radians(angle)) for angle in place[:2])
    square = _FLATTENING * (2 - _FLATTENING)
    across = _RADIUS / np.sqrt(1 - square * float(s) ** 2)
    flat = (across + place.altitude) * float(c)
    return np.array([flat * float(d), flat * float(t), (across * (1 - square) + place.altitude) * float(s)])


def frame_between(first: Floats, second: Floats, distance: float, names: str) -> Frame:
    """Return the frame that scales the world so that two positions (3,) are `distance` apart. Raises InvalidScene."""
    found = length(first - second)
    if not found > 1e-9 * float(np.abs([first, second]).max()):
        raise InvalidScene(Problem(names, "are at the same place", "two places with a distance"))
    scale = distance / found
    if not 1e-9 <= scale <= 1e9:
        raise InvalidScene(Problem(names, f"are {found:g} units apart, a scale of {scale:g}", "1e-9 to 1e9"))
    return Frame(scale)


def frame_to_positions(eyes: Floats, positions: Floats) -> Fitted:
    """Return the similarity that takes cameras (n, 3) to known positions (n, 3), of which up to half may be wrong.

    Raises InvalidScene for fewer than three, and for cameras or positions that are all at one place.
    """
    n = len(eyes)
    if n < LEAST:
        raise InvalidScene(Problem("the positions", f"are {n}", f"those of {LEAST} cameras or more"))
    some = np.arange(0, n, -(-n // _LOOKED_AT))
    random = np.random.default_rng(0)
    best: tuple[float, Frame] | None = None
    for _ in range(_TRIALS):
        chosen = random.choice(n, 3, replace=False)
        frame = _similarity(eyes[chosen], positions[chosen])
        if frame is None:
            continue
        median = float(np.median(_residuals(frame, eyes[some], positions[some])))
        if best is None or median < best[0]:
            best = median, frame
    if best is None:
        raise InvalidScene(Problem("the cameras", "or their known positions are all at one place", "a distance"))
    median, frame = best
    near = np.ones(n, bool)
    for _ in range(2):
        residuals = _residuals(frame, eyes, positions)
        near = residuals <= max(_OUT * (1 + 5 / max(n - 3, 1)) * median, 1e-12 * float(np.abs(positions).max()))
        refined = _similarity(eyes[near], positions[near]) if near.sum() >= LEAST else None
        if refined is None:
            break
        frame = refined
        median = float(np.median(_residuals(frame, eyes[near], positions[near])))
    away = positions[near] - positions[near].mean(axis=0)
    spread = float(np.sqrt((away * away).sum(axis=1).mean()))
    second = float(np.sqrt(max(eigenvectors(_covariance(away, away))[0][1], 0.0)))
    turned = second > max(_LINE * median, _WIDE * spread)
    if not turned:
        frame = Frame(frame.scale)
    return Fitted(frame, median, spread, int(near.sum()), turned)


def _residuals(frame: Frame, eyes: Floats, positions: Floats) -> Floats:
    away = transform_points(eyes, frame.matrix) - positions
    return np.asarray(np.sqrt((away * away).sum(axis=1)))


def _covariance(a: Floats, b: Floats) -> Floats:
    return np.asarray((a[:, :, None] * b[:, None]).mean(axis=0))


def _similarity(eyes: Floats, positions: Floats) -> Frame | None:
    """The frame with the least squares of residuals (Horn); None for points that are all at one place."""
    from_middle, to_middle = eyes.mean(axis=0), positions.mean(axis=0)
    a, b = eyes - from_middle, positions - to_middle
    before, after = float((a * a).sum()), float((b * b).sum())
    if not (before > 1e-20 * float((eyes * eyes).sum()) and after > 1e-20 * float((positions * positions).sum())):
        return None
    M = _covariance(a / np.sqrt(before), b / np.sqrt(after))
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = M.tolist()
    N = np.array(
        [
            [xx + yy + zz, yz - zy, zx - xz, xy - yx],
            [yz - zy, xx - yy - zz, xy + yx, zx + xz],
            [zx - xz, xy + yx, yy - xx - zz, yz + zy],
            [xy - yx, zx + xz, yz + zy, zz - xx - yy],
        ]
    )
    w, x, y, z = eigenvectors(N)[1][:, 0].tolist()
    turn = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    scale = float(np.sqrt(after / before))
    return Frame(scale, turn, to_middle - scale * rotate(from_middle, turn))


def vertical_of(cameras: Cameras) -> Floats:
    """Return the direction (3,) that points up for cameras that were held level, from their sideways axes.

    Raises InvalidScene if these are parallel, because then two directions are equally level.
    """
    sideways = np.stack([camera.pose[:3, 0] for camera in cameras.cameras])
    values, axes = eigenvectors(_covariance(sideways, sideways))
    up = axes[:, 2].copy()
    if not values[1] > _LEVEL:
        raise InvalidScene(Problem("the cameras", "do not tell which way is up", "cameras that look to several sides"))
    ups = np.stack([camera.pose[:3, 1] for camera in cameras.cameras])
    # Photographs of a flight straight down have their upper edges in all directions, but look down.
    sign = float(rotate(ups.mean(axis=0), np.broadcast_to(up, (3, 3)))[0])
    down = float(rotate(cameras.axes.mean(axis=0), np.broadcast_to(up, (3, 3)))[0])
    return up if sign - down > 0 else -up


class Gravity(NamedTuple):
    """frame: in it z points up. off: the median angle from it, in degrees. used: the number of cameras that agree."""

    frame: Frame
    off: float
    used: int


def frame_of_gravity(cameras: Cameras, ups: Sequence[tuple[float, float, float]]) -> Gravity:
    """Return the world whose z is the mean of what points up in the pictures, of which up to half may be wrong.

    ups: a unit vector for each camera, in its axes. Raises InvalidScene if they do not agree.
    """
    pairs = zip(ups, cameras.cameras, strict=True)
    directions = np.stack([rotate(np.array(up), camera.pose[:3, :3]) for up, camera in pairs])
    up = np.median(directions, axis=0)
    for _ in range(_ROUNDS):
        up = up / max(length(up), 1e-9)
        away = np.asarray(np.sqrt(np.square(directions - up).sum(axis=1)))
        near = away <= max(_OUT * float(np.median(away)), _EQUAL)
        up = directions[near].mean(axis=0)
    off = float(np.degrees(np.median(away)))
    if off > _UPRIGHT:
        found = f"differ by {off:.2g} degrees at the median of {plural(len(ups), 'picture')}"
        raise InvalidScene(Problem("the directions of gravity", found, f"up to {_UPRIGHT:g} degrees"))
    return Gravity(Frame(turn=_turn_to_z(up / length(up))), off, int(near.sum()))


class Ground(NamedTuple):
    """frame: in it the ground is z = 0. height: of its middle along `up`. share: of the points that lie on it."""

    frame: Frame
    height: float
    share: float


def frame_of_ground(cameras: Cameras, up: Floats) -> Ground:
    """Return the ground among the sparse points of cameras. up (3,): a unit vector that points up, or nearly so.

    The ground is the plane with most points of those up to 30 degrees from
    level that have at most 5 % of the points below them, and the cameras above. Raises InvalidScene if there is none.
    """
    points = cameras.points
    if points is None or len(points) < _FEW:
        found = "are missing" if points is None else f"are {len(points)}"
        raise InvalidScene(Problem("the sparse points", found, f"{_FEW} or more, to find the ground"))
    positions = points.positions
    some = positions[np.arange(0, len(positions), -(-len(positions) // _LOOKED_AT))]
    middle = np.median(some, axis=0)
    away = some - middle
    thick = _THICK * 2 * float(np.median(np.sqrt((away * away).sum(axis=1))))
    eye = np.median(cameras.eyes, axis=0) - middle
    random = np.random.default_rng(0)
    best, plane = 0, None
    for _ in range(2 * _TRIALS):
        a, b, c = away[random.choice(len(away), 3, replace=False)]
        normal = np.cross(b - a, c - a)
        if not length(normal) > 0:
            continue
        normal = normal / length(normal)
        cosine = float((normal * up).sum())
        if abs(cosine) < _STEEP:
            continue
        normal = normal if cosine > 0 else -normal
        height = _heights(away, normal, a)
        count = int((np.abs(height) <= thick).sum())
        if count > best and _is_lowest(height, thick) and float(((eye - a) * normal).sum()) > 0:
            best, plane = count, (normal, a)
    if plane is None or best < _LEAST_GROUND * len(some):
        raise InvalidScene(Problem("the ground", "was not found", "a plane of sparse points below the cameras"))
    normal, through = plane
    for _ in range(2):
        on = away[np.abs(_heights(away, normal, through)) <= thick]
        through = on.mean(axis=0)
        axis = eigenvectors(_covariance(on - through, on - through))[1][:, 2]
        normal = axis if float((axis * normal).sum()) > 0 else -axis
    share = float((np.abs(_heights(away, normal, through)) <= thick).mean())
    turn = _turn_to_z(normal)
    shift = np.array([0.0, 0.0, -float(rotate(through + middle, turn)[2])])
    return Ground(Frame(1.0, turn, shift), float(((through + middle) * up).sum()), share)


def lowered(height: float, origin: Floats) -> Frame:
    """The frame that puts this height, of a world relative to an origin, at z = 0, and undoes the origin in x and y."""
    return Frame(shift=np.array([origin[0], origin[1], -height]))


def _heights(points: Floats, normal: Floats, through: Floats) -> Floats:
    x, y, z = (points - through).T
    return np.asarray(x * normal[0] + y * normal[1] + z * normal[2])


def _is_lowest(height: Floats, thick: float) -> bool:
    return float((height < -3 * thick).mean()) <= _BELOW


def _turn_to_z(axis: Floats) -> npt.NDArray[np.float64]:
    """The rotation (3, 3) by the smallest angle that takes a unit vector to z."""
    x, y, z = axis.tolist()
    if z < -1 + 1e-12:
        return np.diag([1.0, -1.0, -1.0])
    across = np.array([[0.0, 0.0, -x], [0.0, 0.0, -y], [x, y, 0.0]])
    return np.asarray(np.eye(3) + across + compose(across, across) / (1 + z))
