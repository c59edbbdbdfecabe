"""Splats moved by the matrix of a node whose scale may differ along its axes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from nerfbake import memory
from nerfbake.kernels.arrays import Floats
from nerfbake.kernels.march.sh import rotation_of_sh
from nerfbake.kernels.maths.affine import compose, transform_points
from nerfbake.kernels.maths.elementary import cast
from nerfbake.scene.base import MAX_WORLD
from nerfbake.scene.splats import EVEN, Splats, turned_sh

_BYTES = 600  # a splat, while its ellipsoid is stretched
_SWEEPS = 10  # of rotations: 6 are enough for the conformance set
_NOTHING = 1e-150  # length below which a direction is not defined


def placed_by(splats: Splats, matrix: Floats) -> Splats:
    """Return the splats moved by a (3, 4) matrix: a rotation or reflection after scales along the axes, and a shift.

    If the scales differ, ellipsoids are stretched to ellipsoids, and SH are turned by the rotation alone, as
    KHR_gaussian_splatting says. Raises InvalidScene for a matrix that shears.
    """
    linear = matrix[:3, :3]
    with np.errstate(all="ignore"):
        lengths = np.sqrt((linear * linear).sum(axis=0))
        turn = linear / lengths
        off = float(np.abs(compose(turn.T.copy(), turn) - np.eye(3)).max())
        even = float(np.abs(lengths / lengths[0] - 1).max())
    stretches = off <= EVEN < even and bool((lengths <= MAX_WORLD).all())  # False for NaN, which is refused below
    if not stretches:
        return splats.transformed(matrix)
    with memory.lent("the splats", _BYTES * splats.n):
        axes = _rotations(splats.quats.astype(np.float64)) * splats.scales.astype(np.float64)[:, None, :]
        scales, turns = _ellipsoids(np.stack([(linear[i][:, None] * axes).sum(axis=1) for i in range(3)], axis=1))
        return replace(
            splats,
            means=np.ascontiguousarray(cast(transform_points(splats.means, matrix), np.float32)),
            scales=np.ascontiguousarray(cast(scales, np.float32)),
            quats=np.ascontiguousarray(cast(_quaternions(turns), np.float32)),
            sh=turned_sh(splats.sh, rotation_of_sh(turn, splats.B)),
            up=None,
        )


def _rotations(quats: Floats) -> Floats:
    """(n, 3, 3) the matrices of unit quaternions w, x, y, z."""
    w, x, y, z = quats.T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=1)


def _ellipsoids(axes: Floats) -> tuple[Floats, Floats]:
    """Return semi-axes (n, 3), the largest first, and rotations (n, 3, 3) of the ellipsoids A A' of matrices A.

    The columns of A are rotated in pairs until they are at right angles (one-sided Jacobi), which keeps A A'.
    """
    columns = [np.ascontiguousarray(axes[:, :, k]) for k in range(3)]
    for _ in range(_SWEEPS):
        for p, q in ((0, 1), (0, 2), (1, 2)):
            a, b = columns[p], columns[q]
            own, other, both = (a * a).sum(axis=1), (b * b).sum(axis=1), (a * b).sum(axis=1)
            apart = np.where(both == 0, 1.0, both)
            slope = (other - own) / (2 * apart)
            tangent = np.where(slope < 0, -1.0, 1.0) / (np.abs(slope) + np.sqrt(1 + slope * slope))
            tangent = np.where(both == 0, 0.0, tangent)
            cosine = (1 / np.sqrt(1 + tangent * tangent))[:, None]
            sine = cosine * tangent[:, None]
            columns[p], columns[q] = cosine * a - sine * b, sine * a + cosine * b
    lengths = np.stack([np.sqrt((column * column).sum(axis=1)) for column in columns], axis=1)
    order = np.argsort(-lengths, axis=1, kind="stable")
    rows = np.arange(len(axes))
    stacked = np.stack(columns, axis=1)
    first = _unit(stacked[rows, order[:, 0]], np.array([1.0, 0, 0]))
    second = stacked[rows, order[:, 1]]
    second = second - (second * first).sum(axis=1)[:, None] * first
    around = np.eye(3)[np.abs(first).argmin(axis=1)]
    second = _unit(second, _cross(first, around))
    second = _unit(second, second)
    third = _cross(first, second)
    return np.take_along_axis(lengths, order, axis=1), np.stack([first, second, third], axis=2)


def _unit(vectors: Floats, instead: Floats) -> Floats:
    """(n, 3) vectors of length 1; others in place of those that have none."""
    chosen = np.where(((vectors * vectors).sum(axis=1) > _NOTHING**2)[:, None], vectors, instead)
    return np.asarray(chosen / np.sqrt((chosen * chosen).sum(axis=1))[:, None])


def _cross(a: Floats, b: Floats) -> Floats:
    return np.asarray(np.cross(a, b), np.float64)


def _quaternions(m: Floats) -> Floats:
    """(n, 4) unit quaternions w, x, y, z of rotations (n, 3, 3), each from the largest of its components."""
    xx, yy, zz = m[:, 0, 0], m[:, 1, 1], m[:, 2, 2]
    a, b, c = m[:, 2, 1] - m[:, 1, 2], m[:, 0, 2] - m[:, 2, 0], m[:, 1, 0] - m[:, 0, 1]
    d, e, f = m[:, 0, 1] + m[:, 1, 0], m[:, 0, 2] + m[:, 2, 0], m[:, 1, 2] + m[:, 2, 1]
    products = np.stack(  # (n, 4, 4): 4 q q'
        [
            np.stack([1 + xx + yy + zz, a, b, c], axis=1),
            np.stack([a, 1 + xx - yy - zz, d, e], axis=1),
            np.stack([b, d, 1 - xx + yy - zz, f], axis=1),
            np.stack([c, e, f, 1 - xx - yy + zz], axis=1),
        ],
        axis=1,
    )
    largest = np.diagonal(products, axis1=1, axis2=2).argmax(axis=1)
    chosen = products[np.arange(len(m)), largest]
    return np.asarray(chosen / np.sqrt((chosen * chosen).sum(axis=1))[:, None])
