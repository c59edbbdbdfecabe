"""Radiance field -> Gaussian splats, one for each of the leaves that contribute most to pictures."""

from __future__ import annotations

import numpy as np

from nerfbake import memory
from nerfbake.errors import InvalidScene, Problem
from nerfbake.kernels.arrays import Floats, Ints, Points, Singles
from nerfbake.kernels.march.cells import rows_at
from nerfbake.kernels.march.sh import sh_basis
from nerfbake.kernels.maths.affine import inverse, rotate
from nerfbake.kernels.maths.elementary import expm1, fibonacci, sigmoid
from nerfbake.kernels.maths.linear import product, solve_each
from nerfbake.scene.camera import Cameras
from nerfbake.scene.radiance_field import RadianceField, leaves_of, require_field
from nerfbake.scene.splats import Splats
from nerfbake.stages._basis_functions import basis_at
from nerfbake.stages.field_to_importance import weigh_leaves
from nerfbake.stages.scene_to_cameras import scatter_cameras, without_strays

COUNT = 150_000
_SHARE = 1 / 255  # smallest contribution of a leaf that is visible
_SPREAD = 0.33  # standard deviation of a splat, in edges of its leaf
_MOST_GROWTH = 2.5
_DIRECTIONS = 64  # in which the colours are compared
_MOST_BASIS = 16  # coefficients that .ply and .glb can hold
_FRAMES, _EDGE, _ZOOM = 48, 256, 1.13
_CHUNK = 1 << 13  # leaves whose colours are refitted at a time
_SPLAT_BYTES = 400
_MOST_OPACITY = 0.99


def build_splats(field: RadianceField, *, count: int = COUNT, cameras: Cameras | None = None) -> Splats:
    """Return at most `count` splats: the leaves with the largest share of any pixel of the cameras, in their order.

    A splat's standard deviations are 0.33 edges of its leaf. If leaves are left out, the others grow by the square root
    of visible / kept, since leaves cover surfaces. The opacity is that along an edge of the leaf; SH are those whose
    max(0, SH + 1/2) is most similar to the leaf's colours, of degree 3 at most. The splats are antialiased: others that
    are right at one size of a picture are too thin in larger ones (2 to 3 dB at twice the size).

    These splats are a start for fit_splats(), which makes them 3 to 5 dB better. cameras: where the scene is seen from;
    None: all around it. Raises InvalidScene if nothing is visible, MemoryLimit. Source: none; the idea of choosing by
    the largest share is from Mini-Splatting (Fang and Wang, 2024) and RadSplat (Niemeyer et al., 2024).

    >>> from nerfbake import build_field, build_splats, sample_n3tree
    >>> print(build_splats(build_field(sample_n3tree(resolution=16)), count=300))
    300 splats of SH degree 2
    """
    require_field(field)
    if count < 1:
        raise InvalidScene(Problem("count", f"is {count}", "1 or more"))
    if cameras is None:
        cameras = scatter_cameras(without_strays(field), frames=_FRAMES, edge=_EDGE, zoom=_ZOOM)
    largest = weigh_leaves(field, cameras).largest
    visible = int(np.count_nonzero(largest >= _SHARE))
    if not visible:
        raise InvalidScene(Problem("the field", "shows nothing in any picture", "a leaf with a density"))
    kept = min(count, visible)
    memory.require(f"{kept:,} splats", _SPLAT_BYTES * kept)
    rows = np.sort(np.argsort(-largest, kind="stable")[:kept])
    centres, widths = _places(field, rows)
    edges = inverse(field.place[:, :3])  # columns: the edges of a cell in the world
    lengths = np.sqrt((edges * edges).sum(axis=0))
    grown = _SPREAD * min(float(np.sqrt(visible / kept)), _MOST_GROWTH)
    scales = grown * widths[:, None] * lengths
    depth = np.maximum(field.values[rows, -1], 0) * (widths * lengths.mean())
    alpha = np.minimum(-expm1(-depth), _MOST_OPACITY)
    turn = np.tile(_quaternion(field.axes), (kept, 1))
    parts = (field.world(centres), scales, turn, alpha)
    means, scales, quats, alphas = (np.ascontiguousarray(part, np.float32) for part in parts)
    return memory.kept(Splats(means, scales, quats, alphas, _harmonics(field, rows), antialiased=True))


def _places(field: RadianceField, rows: Ints) -> tuple[Points, Floats]:
    """Return the centres (m, 3) and the widths (m,) of leaves, in cells."""
    centres, widths = np.zeros((len(field.values), 3)), np.zeros(len(field.values))
    for corners, width in leaves_of(field.cells):
        found = rows_at(field.cells, corners + 0.5)
        centres[found], widths[found] = corners + width / 2, width
    return centres[rows], widths[rows]


def _harmonics(field: RadianceField, rows: Ints) -> Singles:
    """Return the SH (m, B, 3), in the world's axes, of colours without the sigmoid."""
    B = min(field.basis.size, _MOST_BASIS)
    ways = fibonacci(_DIRECTIONS)
    ours = sh_basis(ways, B)
    theirs = np.ascontiguousarray(basis_at(field.basis, rotate(ways, field.axes)).T)
    across = np.ascontiguousarray(ours.T)
    fitted = np.ascontiguousarray(solve_each(product(across, ours)[None], across[None])[0].T)  # (directions, B)
    out = np.empty((len(rows), B, 3), np.float32)
    for begin in range(0, len(rows), _CHUNK):
        some = rows[begin : begin + _CHUNK]
        for channel in range(3):
            size = field.basis.size
            values = field.values[some, channel * size : (channel + 1) * size].astype(np.float64)
            out[begin : begin + len(some), :, channel] = product(sigmoid(product(values, theirs)) - 0.5, fitted)
    return out


def _quaternion(axes: Points) -> Floats:
    """Return the unit quaternion (4,) w, x, y, z that turns the world's axes to these orthonormal rows.

    A mirrored frame becomes a rotation by turning its third axis round, which makes no difference to a Gaussian.
    """
    x, y, _ = axes
    turn = np.stack([x, y, np.cross(x, y)], axis=1)
    # Of the four ways to get a quaternion, the one without a cancellation.
    trace = turn[0, 0] + turn[1, 1] + turn[2, 2]
    squares = np.array([trace, *(2 * turn[k, k] - trace for k in range(3))]) + 1
    skew = np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
    k = int(np.argmax(squares))
    if k == 0:
        quat = np.array([squares[0], *skew])
    else:
        quat = np.zeros(4)
        quat[0] = skew[k - 1]
        quat[1:] = turn[k - 1] + turn[:, k - 1]
        quat[k] = squares[k]
    return np.asarray(quat / np.sqrt((quat * quat).sum()), np.float64)
