"""Triangles seen along rays from one point: the nearest triangle of each pixel, its weights, and its distance.

With corners v0, v1, v2 relative to the camera and a ray d, the weights are d . (v1 x v2), d . (v2 x v0), d . (v0 x v1).
They all have the same sign where the line of the ray hits the triangle; divided by their sum, they are the barycentric
coordinates. This holds for corners behind the camera too, so nothing is clipped. Two triangles get the same numbers
with opposite signs for a shared edge, so no ray passes between them.
Source: Olano and Greer, "Triangle scan conversion using 2D homogeneous coordinates" (1997).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake.errors import InvalidScene, Problem
from nerfbake.kernels.arrays import Floats
from nerfbake.kernels.jit import borrowed, compiled, part_of
from nerfbake.kernels.maths.affine import inverse, rotate
from nerfbake.kernels.parallel import on_every_core

NONE = -1
_ROWS = 16  # in a band: each band is processed by one thread, so no two threads write to the same pixel
_MARGIN = 1e-3  # of a pixel, around the box of a triangle, for rounding
_CLOSE = 1e-9  # relative to the corners: rounding may move a point this close to a side to the other side


class GBuffer(NamedTuple):
    """triangle is NONE, weights are 0 and distance is inf where a ray hits nothing."""

    triangle: npt.NDArray[np.int32]  # (H, W)
    weights: npt.NDArray[np.float32]  # (H, W, 3) weights of its corners; their sum is 1
    distance: Floats  # (H, W) along the ray


class Holes(NamedTuple):
    """Texels that rays pass through. A ray meets the nearest texel, as kernels.surface.texture.nearest_texel() does."""

    uvs: npt.NDArray[np.float32]  # (v, 2) of the vertices
    owner: npt.NDArray[np.int32]  # (t,) the mask of each triangle; -1 for none
    masks: npt.NDArray[np.int64]  # (n, 3) place of the first texel, height and width
    opaque: npt.NDArray[np.bool_]  # the texels of all masks


def no_holes() -> Holes:
    return Holes(np.zeros((0, 2), np.float32), np.zeros(0, np.int32), np.zeros((0, 3), np.int64), np.zeros(0, np.bool_))


def gbuffer(
    positions: npt.NDArray[np.float32],
    faces: npt.NDArray[np.uint32],
    pose: Floats,
    rays: Floats,
    holes: Holes | None = None,
) -> GBuffer:
    """The nearest of t triangles for each pixel, on either side of the triangle; the first of equally near ones.

    holes: texels of the triangles that rays pass through.

    positions (v, 3), faces (t, 3). pose (4, 4): camera to world, OpenGL axes. rays (H, W, 3): the world directions
    through the pixel centres; distances are in units of their lengths. The rays may come from any lens, if all of them
    point forwards and none is far from the directions of its neighbours. Raises InvalidScene if a ray does not point
    forwards.
    """
    H, W, _ = rays.shape
    turn = inverse(pose[:3, :3])
    points, looks = rotate(positions - pose[:3, 3], turn), np.empty((H, W, 3))
    _turn(rays, turn, looks)
    if not (looks[..., 2] < 0).all():
        raise InvalidScene(
            Problem("the camera", "looks 90 degrees or more to a side", "less than 90 degrees for scenes with meshes")
        )
    columns = _rising(looks[..., 0] / -looks[..., 2])
    rows = _rising(looks[..., 1].T / looks[..., 2].T)
    found = GBuffer(np.full((H, W), NONE, np.int32), np.zeros((H, W, 3), np.float32), np.full((H, W), np.inf))
    boxes = np.zeros((len(faces), 4), np.int32)
    _bound(points, faces, columns, rows, boxes)
    _fill(points, faces, boxes, looks, no_holes() if holes is None else holes, *found)
    return found


@on_every_core
@compiled()
def _turn(core: int, cores: int, rays: Floats, matrix: Floats, out: Floats) -> None:
    """rotate() on all cores; rotate() itself took a third of the time."""
    for y in range(core, rays.shape[0], cores):
        for x in range(rays.shape[1]):
            a, b, c = rays[y, x, 0], rays[y, x, 1], rays[y, x, 2]
            for axis in range(3):
                out[y, x, axis] = a * matrix[axis, 0] + b * matrix[axis, 1] + c * matrix[axis, 2]


def _rising(at: Floats) -> Floats:
    """(2, W): the largest coordinate of any column up to each one, and the smallest of any column from each one on.

    at (H, W): coordinates of the pixel centres along the columns, on the plane in front of the camera. Both rows rise,
    so a search finds the columns that may see a position.
    """
    most, least = at.max(axis=0), at.min(axis=0)
    margin = _MARGIN * (most.max() - least.min()) / len(most) + _CLOSE * np.abs(at).max()
    low = np.minimum.accumulate(least[::-1])[::-1] - margin
    return np.stack([np.maximum.accumulate(most) + margin, low])


@on_every_core
@compiled()
def _bound(
    core: int,
    cores: int,
    points: Floats,
    faces: npt.NDArray[np.uint32],
    columns: Floats,
    rows: Floats,
    boxes: npt.NDArray[np.int32],
) -> None:
    """Fill (t, 4) the pixels that may see each triangle: left, top, right, bottom, the last two exclusive."""
    points, faces, columns, rows, boxes = borrowed((points, faces, columns, rows, boxes))
    begin, end = part_of(len(faces), core, cores)
    for f in range(begin, end):
        left, right, top, bottom = np.inf, -np.inf, np.inf, -np.inf
        for corner in range(3):
            p, q = points[faces[f, corner]], points[faces[f, (corner + 1) % 3]]
            if p[2] < 0:
                x, y = -p[0] / p[2], p[1] / p[2]
                left, right, top, bottom = min(left, x), max(right, x), min(top, y), max(bottom, y)
            if (p[2] < 0) != (q[2] < 0):
                # The edge crosses the plane of the camera: its image extends to infinity on that side.
                s = p[2] / (p[2] - q[2])
                x, y = p[0] + s * (q[0] - p[0]), p[1] + s * (q[1] - p[1])
                close = _CLOSE * (abs(p[0]) + abs(q[0]) + abs(p[1]) + abs(q[1]))
                left, right = -np.inf if x < close else left, np.inf if x > -close else right
                top, bottom = -np.inf if y > -close else top, np.inf if y < close else bottom
        if left <= right:
            boxes[f, 0], boxes[f, 1] = _below(columns, 0, left, True), _below(rows, 0, top, True)
            boxes[f, 2], boxes[f, 3] = _below(columns, 1, right, False), _below(rows, 1, bottom, False)


@compiled()
def _below(table: Floats, row: int, value: float, strictly: bool) -> int:
    """Number of entries of a rising row that are below a value (strictly) or not above it."""
    first, count = 0, table.shape[1]
    while count > 0:
        half = count >> 1
        here = table[row, first + half]
        if here < value or (here == value and not strictly):
            first += half + 1
            count -= half + 1
        else:
            count = half
    return first


@compiled()
def _is_opaque(holes: Holes, f: int, faces: npt.NDArray[np.uint32], u: float, v: float, w: float) -> bool:
    """Whether the texel of triangle f at these weights is there. The operations of Hits.uvs and nearest_texel()."""
    first, H, W = holes.masks[holes.owner[f], 0], holes.masks[holes.owner[f], 1], holes.masks[holes.owner[f], 2]
    p, q, r = np.float32(u), np.float32(v), np.float32(w)
    a, b, c = holes.uvs[faces[f, 0]], holes.uvs[faces[f, 1]], holes.uvs[faces[f, 2]]
    across, down = p * a[0] + q * b[0] + r * c[0], p * a[1] + q * b[1] + r * c[1]
    x = int(np.float64(across - np.floor(across)) * W) % W
    y = int(np.float64(down - np.floor(down)) * H) % H
    return bool(holes.opaque[first + y * W + x])


@on_every_core
@compiled()
def _fill(
    core: int,
    cores: int,
    points: Floats,
    faces: npt.NDArray[np.uint32],
    boxes: npt.NDArray[np.int32],
    looks: Floats,
    holes: Holes,
    triangle: npt.NDArray[np.int32],
    weights: npt.NDArray[np.float32],
    distance: Floats,
) -> None:
    H, holed = len(looks), len(holes.owner) > 0
    for band in range(core, (H + _ROWS - 1) // _ROWS, cores):
        for f in range(len(faces)):
            top, bottom = max(boxes[f, 1], band * _ROWS), min(boxes[f, 3], (band + 1) * _ROWS)
            if top >= bottom:
                continue
            a, b, c = points[faces[f, 0]], points[faces[f, 1]], points[faces[f, 2]]
            a0, a1, a2 = b[1] * c[2] - b[2] * c[1], b[2] * c[0] - b[0] * c[2], b[0] * c[1] - b[1] * c[0]
            b0, b1, b2 = c[1] * a[2] - c[2] * a[1], c[2] * a[0] - c[0] * a[2], c[0] * a[1] - c[1] * a[0]
            c0, c1, c2 = a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]
            for y in range(top, bottom):
                for x in range(boxes[f, 0], boxes[f, 2]):
                    d0, d1, d2 = looks[y, x, 0], looks[y, x, 1], looks[y, x, 2]
                    u = d0 * a0 + d1 * a1 + d2 * a2
                    v = d0 * b0 + d1 * b1 + d2 * b2
                    w = d0 * c0 + d1 * c1 + d2 * c2
                    if not ((u >= 0 and v >= 0 and w >= 0) or (u <= 0 and v <= 0 and w <= 0)):
                        continue
                    total = u + v + w
                    if total == 0:
                        continue  # seen edge-on
                    u, v, w = u / total, v / total, w / total
                    # A weighted mean of the corners, so rounding never moves it in front of or behind all of them.
                    far = (u * a[2] + v * b[2] + w * c[2]) / d2
                    if 0 < far < distance[y, x]:
                        if holed and holes.owner[f] >= 0 and not _is_opaque(holes, f, faces, u, v, w):
                            continue
                        distance[y, x], triangle[y, x] = far, f
                        weights[y, x, 0], weights[y, x, 1], weights[y, x, 2] = u, v, w
