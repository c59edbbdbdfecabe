"""Two versions of the same splats -> what the second lacks of the first."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from nerfbake.errors import InvalidScene, Problem
from nerfbake.kernels.arrays import Floats, Singles
from nerfbake.kernels.march.sh import sh_basis
from nerfbake.kernels.maths.elementary import arctan, fibonacci
from nerfbake.scene.splats import Splats

_DIRECTIONS = 16  # in which colours are compared
_ROWS = 1 << 14  # compared at a time: 6 MB of colours
_TINY = 1e-30  # scale below which splats are the same


class SplatError(NamedTuple):
    """The largest and the median error over all splats."""

    largest: float
    median: float


class SplatLoss(NamedTuple):
    """Errors of splats.

    means          distance of the centres, world units
    scales         largest of the three axes, as a share of the scale
    rotations      angle, degrees
    opacity        difference
    colours        largest difference of a channel in 16 directions, in steps of 1/255
    dropped_bands  bands of SH that are missing
    """

    means: SplatError
    scales: SplatError
    rotations: SplatError
    opacity: SplatError
    colours: SplatError
    dropped_bands: int


def measure_splats(before: Splats, after: Splats) -> SplatLoss:
    """Return the errors of `after`, whose rows are those of `before`, in order.

    Raises InvalidScene for another number of rows.

    >>> import numpy as np
    >>> from nerfbake import Splats, measure_splats
    >>> place, turn = np.zeros((1, 3), np.float32), np.array([[1, 0, 0, 0]], np.float32)
    >>> one = Splats(place, place + 1, turn, np.ones(1, np.float32), np.zeros((1, 1, 3), np.float32))
    >>> measure_splats(one, one.with_degree(0)).means
    SplatError(largest=0.0, median=0.0)
    """
    if before.n != after.n:
        raise InvalidScene(Problem("the second splats", f"are {after.n:,}", f"{before.n:,}, as the first"))
    moved = after.means.astype(np.float64) - before.means + (after.origin - before.origin)
    one, other = (np.maximum(splats.scales.astype(np.float64), _TINY) for splats in (before, after))
    return SplatLoss(
        means=_of(np.sqrt((moved * moved).sum(axis=1))),
        scales=_of(np.abs(other / one - 1).max(axis=1)),
        rotations=_of(_angles(before.quats.astype(np.float64), after.quats.astype(np.float64))),
        opacity=_of(np.abs(after.opacity.astype(np.float64) - before.opacity)),
        colours=_of(_colour_errors(before, after) * 255),
        dropped_bands=max(0, before.degree - after.degree),
    )


def _of(errors: Floats) -> SplatError:
    return SplatError(float(errors.max()), float(np.median(errors)))


def _angles(one: Floats, other: Floats) -> Floats:
    """(n,) degrees between the rotations of unit quaternions, which q and -q both represent."""
    chords = [((one - sign * other) ** 2).sum(axis=1) for sign in (1, -1)]
    square = np.minimum(*chords)  # of a chord of the unit sphere: 2 sin of a quarter of the angle
    return np.asarray(4 * 180 / np.pi * arctan(np.sqrt(square / (4 - square))))


def _colour_errors(before: Splats, after: Splats) -> Floats:
    directions = fibonacci(_DIRECTIONS)
    errors = np.empty(before.n)
    for start in range(0, before.n, _ROWS):
        part = slice(start, start + _ROWS)
        one, other = (_colours(splats.sh[part], sh_basis(directions, splats.B)) for splats in (before, after))
        errors[part] = np.abs(one - other).max(axis=(1, 2))
    return errors


def _colours(sh: Singles, basis: Floats) -> Floats:
    """(n, directions, 3) what is shown, 0 to 1."""
    total = np.full((len(sh), len(basis), 3), 0.5)
    for b in range(basis.shape[1]):
        total += basis[:, b, None] * sh[:, b, None, :].astype(np.float64)
    return np.asarray(np.clip(total, 0, 1))
