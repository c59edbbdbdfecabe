"""What a pose may be: 4 x 4 plain Python numbers, which are fast enough for captures with many frames."""

from __future__ import annotations

import math

from nerfbake.scene.base import MAX_WORLD

MAX_AXIS = 1e6  # largest component of a pose's axes, and of one over it
MIN_VOLUME = 1e-12  # smallest volume of the box that a pose's axes span, relative to a cube of their largest component
ORTHOGONAL = 1e-3  # tolerance for the axes of a rotation, for rounding in files


def pose_problem(rows: list[list[float]]) -> tuple[str, str] | None:
    """What was found and what is allowed, for an invalid pose of 4 x 4 numbers; None if it is valid."""
    if not all(math.isfinite(value) for row in rows for value in row):
        return "has a pose with NaN or infinity", "4 x 4 finite numbers"
    (a, b, c, x), (d, e, f, y), (g, h, i, z), last = rows
    if (most := max(abs(x), abs(y), abs(z))) > MAX_WORLD:
        return f"has a coordinate of {most:g}", f"up to {MAX_WORLD:g} world units"
    if (most := max(abs(value) for row in rows[:3] for value in row[:3])) > MAX_AXIS:
        return f"has a pose with an axis of {most:g}", f"a rotation, or axes up to {MAX_AXIS:g}"
    volume = a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g)
    if most < 1 / MAX_AXIS or not abs(volume) > MIN_VOLUME * min(most, 1) ** 3:
        return "has a singular pose", "an invertible rotation"
    if last != [0, 0, 0, 1]:
        return f"has a pose whose last row is {last}", "0, 0, 0, 1"
    return None


def scale_of(rows: list[list[float]]) -> float:
    """The number that the axes of a pose are a rotation or a reflection times; 1 if they are neither.

    Also 1 if the difference may be rounding, so that such a pose keeps its bits.
    """
    (a, b, c, _), (d, e, f, _), (g, h, i, _), _ = rows
    right, up, back = a * a + d * d + g * g, b * b + e * e + h * h, c * c + f * f + i * i
    square = (right + up + back) / 3
    skew = max(abs(a * b + d * e + g * h), abs(a * c + d * f + g * i), abs(b * c + e * f + h * i))
    lengths = right, up, back
    if max(skew, *(abs(length - 1) for length in lengths)) <= ORTHOGONAL:
        return 1.0
    alike = max(skew, *(abs(length - square) for length in lengths)) <= ORTHOGONAL * square
    return math.sqrt(square) if alike else 1.0
