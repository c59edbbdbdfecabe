"""Rotations and poses as camera files spell them, all returned as matrices.

R is world to camera with OpenCV's axes (x right, y down, z forward), t its translation, C = -R^T t the position of the
camera. A pose is camera to world with OpenGL's axes, (4, 4).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from nerfbake.errors import InvalidFile, Problem
from nerfbake.formats.camera.capture import opengl
from nerfbake.kernels.arrays import Floats
from nerfbake.kernels.maths.affine import compose, determinant, inverse, rotate
from nerfbake.kernels.maths.elementary import sine_cosine

_LEAST_AXIS = 1e-12  # length of a row of P = K [R | t], relative to the longest, from which K can be found


def turn_of_quaternion(w: float, x: float, y: float, z: float, place: str) -> Floats:
    """The rotation (3, 3) of a quaternion of any length but 0. place: in the message of the error."""
    square = w * w + x * x + y * y + z * z
    if not 1e-12 < square < 1e12:
        raise InvalidFile(Problem(place, f"has the quaternion {w:g}, {x:g}, {y:g}, {z:g}", "one of length 1"))
    s = 2 / square
    return np.array(
        [
            [1 - s * (y * y + z * z), s * (x * y - w * z), s * (x * z + w * y)],
            [s * (x * y + w * z), 1 - s * (x * x + z * z), s * (y * z - w * x)],
            [s * (x * z - w * y), s * (y * z + w * x), 1 - s * (x * x + y * y)],
        ]
    )


def turn_of_axis_angle(x: float, y: float, z: float) -> Floats:
    """The rotation (3, 3) about an axis by its length in radians (Rodrigues)."""
    angle = math.sqrt(x * x + y * y + z * z)
    if angle == 0:
        return np.eye(3)
    x, y, z = x / angle, y / angle, z / angle
    sine, cosine = (float(value) for value in sine_cosine(angle))
    across = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    axis = np.array([x, y, z])
    return np.asarray(cosine * np.eye(3) + sine * across + (1 - cosine) * axis[:, None] * axis)


def turn_about(axis: int, degrees: float) -> Floats:
    """The right-handed rotation (3, 3) about x (0), y (1) or z (2)."""
    sine, cosine = (float(value) for value in sine_cosine(math.radians(degrees)))
    i, j = (axis + 1) % 3, (axis + 2) % 3
    turn = np.eye(3)
    turn[i, i] = turn[j, j] = cosine
    turn[i, j], turn[j, i] = -sine, sine
    return turn


def pose_at(turn: Floats, centre: Sequence[float] | Floats) -> Floats:
    """The pose of a camera from R (3, 3) and C (3,)."""
    pose = np.eye(4)
    pose[:3, :3] = turn.T
    pose[:3, 3] = centre
    return opengl(pose)


def pose_shifted(turn: Floats, shift: Sequence[float] | Floats) -> Floats:
    """The pose of a camera from R (3, 3) and t (3,)."""
    return pose_at(turn, -rotate(np.asarray(shift, np.float64), turn.T))


def pose_of_world(matrix: Floats) -> Floats:
    """The pose of a camera from its matrix (3 or 4, 4), camera to world, with OpenCV's axes."""
    pose = np.eye(4)
    pose[:3] = matrix[:3]
    return opengl(pose)


def taken_apart(P: Floats, place: str) -> tuple[Floats, Floats, Floats]:
    """K (3, 3), R (3, 3) and C (3,) of P (3, 4) = K [R | t] times any number but 0.

    K has positive focal lengths and a 1 at the end, and R is right-handed: Gram and Schmidt from the last row upwards.
    """
    rows = P[:, :3] / (np.abs(P[:, :3]).max() or 1.0)
    volume = determinant(rows)
    if not abs(volume) > _LEAST_AXIS:
        raise InvalidFile(Problem(place, "is singular", "K [R | t]"))
    if volume < 0:
        rows = -rows
    K, R = np.zeros((3, 3)), np.zeros((3, 3))
    for i in (2, 1, 0):
        left = rows[i].copy()
        for j in range(2, i, -1):
            K[i, j] = float((rows[i] * R[j]).sum())
            left -= K[i, j] * R[j]
        K[i, i] = math.sqrt(float((left * left).sum()))
        R[i] = left / K[i, i]

    return K / K[2, 2], R, -rotate(P[:, 3], inverse(P[:, :3]))


def joined(first: Floats, *others: Floats) -> Floats:
    """The product of square matrices."""
    for other in others:
        first = compose(first, other)
    return first
