"""Normal equations for moving the vertices of a mesh along their normals until it looks like photographs.

The unknowns are the vertices' offsets, in world units. Each face has a block of the matrix for its corners, (t, 6)
float64 as 00, 01, 02, 11, 12, 22, and of the right-hand side, (t, 3). Faces are added in a fixed order, so that every
CPU returns the same bits.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake.kernels.arrays import Faces, Floats, Ints, Singles
from nerfbake.kernels.jit import compiled
from nerfbake.kernels.parallel import on_every_core

_STEP = 0.25  # pixels between two samples across a rim
_REACHES = (3.0, 1.5)  # pixels to either side that are compared, if nothing else is there
_MOST_LENGTH = 4.0  # pixels: a longer edge counts no more, because it is sampled in its middle alone
_LEAST_COSINE = 0.2  # between a ray and a face's normal: below, a texel covers too many pixels
_OUTLIER = 0.1  # of 1: residuals above it count less and less
_SOLVED = 1e-3  # relative residual at which the solver stops


class Solid(NamedTuple):
    """A mesh with its normals and edges.

    positions, normals  (v, 3) in the world; unit normals of the vertices
    faces, facing       (t, 3) and their unit normals
    edges, beside       (e, 2) the vertices of each edge, and the faces to both sides; -1: none
    """

    positions: Floats
    normals: Floats
    faces: Faces
    facing: Floats
    edges: Ints
    beside: Ints


class Equations(NamedTuple):
    """The normal equations, face by face."""

    left: Floats
    right: Floats


class SurfaceEye(NamedTuple):
    """One view: pose (3, 4) camera to world; optics fx, fy, cx, cy; plane (H, W, 2): the positions of the pixels on
    the plane in front of a bent lens, y up; (0, 0, 2) for a pinhole."""

    pose: Floats
    optics: Floats
    plane: Floats


def edges_of(faces: Faces) -> tuple[Ints, Ints]:
    """The edges (e, 2) of a mesh, and the first two faces (e, 2) of each; -1: none."""
    ends = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).astype(np.int64)
    low, high = ends.min(axis=1), ends.max(axis=1)
    count = int(faces.max()) + 1
    keys = low * count + high
    order = np.argsort(keys, kind="stable")
    found, first, times = np.unique(keys[order], return_index=True, return_counts=True)
    owner = order // 3
    second = np.where(times > 1, owner[np.minimum(first + 1, len(owner) - 1)], -1)
    return np.stack([found // count, found % count], axis=1), np.stack([owner[first], second], axis=1)


@compiled(merged=True)
def _project(eye: SurfaceEye, x: float, y: float, z: float) -> Any:
    """Column, row and distance along the axis of a point of the world. Column and row are NaN behind the camera."""
    pose, optics = eye.pose, eye.optics
    v0, v1, v2 = x - pose[0, 3], y - pose[1, 3], z - pose[2, 3]
    right = pose[0, 0] * v0 + pose[1, 0] * v1 + pose[2, 0] * v2
    up = pose[0, 1] * v0 + pose[1, 1] * v1 + pose[2, 1] * v2
    ahead = -(pose[0, 2] * v0 + pose[1, 2] * v1 + pose[2, 2] * v2)
    if ahead <= 0:
        return np.nan, np.nan, ahead
    right, up = right / ahead, up / ahead
    column, row = optics[0] * right + optics[2] - 0.5, -optics[1] * up + optics[3] - 0.5
    H, W = eye.plane.shape[:2]
    if H > 1 and W > 1:
        for _ in range(8):  # the pixel whose direction this is: the lens is nearly a shift around any pixel
            i, j = min(max(int(row), 0), H - 2), min(max(int(column), 0), W - 2)
            fy, fx = min(max(row - i, 0.0), 1.0), min(max(column - j, 0.0), 1.0)
            here0 = _mixed(eye.plane, i, j, fy, fx, 0)
            here1 = _mixed(eye.plane, i, j, fy, fx, 1)
            column += optics[0] * (right - here0)
            row -= optics[1] * (up - here1)
    return column, row, ahead


@compiled(merged=True)
def _mixed(values: Any, i: int, j: int, fy: float, fx: float, channel: int) -> Any:
    top = values[i, j, channel] * (1 - fx) + values[i, j + 1, channel] * fx
    bottom = values[i + 1, j, channel] * (1 - fx) + values[i + 1, j + 1, channel] * fx
    return top * (1 - fy) + bottom * fy


@compiled(merged=True)
def _interpolated(values: Singles, column: float, row: float) -> Any:
    H, W = values.shape
    x, y = min(max(column, 0.0), W - 1.001), min(max(row, 0.0), H - 1.001)
    i, j = int(y), int(x)
    fx, fy = x - j, y - i
    top = values[i, j] * (1 - fx) + values[i, j + 1] * fx
    return top * (1 - fy) + (values[i + 1, j] * (1 - fx) + values[i + 1, j + 1] * fx) * fy


@compiled(merged=True)
def _covered(triangle: npt.NDArray[np.int32], column: float, row: float) -> int:
    """1 where a pixel shows a triangle, 0 where it shows none, -1 outside of the picture."""
    H, W = triangle.shape
    x, y = int(np.floor(column + 0.5)), int(np.floor(row + 0.5))
    if not (0 <= x < W and 0 <= y < H):
        return -1
    return int(triangle[y, x] >= 0)


@compiled()
def add_rims(
    solid: Solid, eye: SurfaceEye, triangle: npt.NDArray[np.int32], rest: Singles, weight: float, blocks: Equations
) -> None:
    """Add one equation for each edge on the rim of the mesh, whose residual is in pixels.

    triangle (H, W): what the mesh shows, -1 for nothing. rest (H, W): the photograph's alpha, less 1 where the mesh
    shows something; its sum across a rim is how far the photograph's rim is outside of the mesh's. weight: of an
    equation, for each pixel of an edge's length. The picture has two pixels or more along each edge.
    """
    p, pose, optics = solid.positions, eye.pose, eye.optics
    for e in range(len(solid.edges)):
        a, b, front, other = solid.edges[e, 0], solid.edges[e, 1], solid.beside[e, 0], solid.beside[e, 1]
        m0, m1, m2 = (p[a, 0] + p[b, 0]) / 2, (p[a, 1] + p[b, 1]) / 2, (p[a, 2] + p[b, 2]) / 2
        v0, v1, v2 = m0 - pose[0, 3], m1 - pose[1, 3], m2 - pose[2, 3]
        side = solid.facing[front, 0] * v0 + solid.facing[front, 1] * v1 + solid.facing[front, 2] * v2
        if other >= 0:
            beyond = solid.facing[other, 0] * v0 + solid.facing[other, 1] * v1 + solid.facing[other, 2] * v2
            if (side < 0) == (beyond < 0):
                continue
            if beyond < 0:
                front = other
        ax, ay, _ = _project(eye, p[a, 0], p[a, 1], p[a, 2])
        bx, by, _ = _project(eye, p[b, 0], p[b, 1], p[b, 2])
        x, y, ahead = _project(eye, m0, m1, m2)
        length = np.sqrt((bx - ax) * (bx - ax) + (by - ay) * (by - ay))
        if not length > 1e-3:  # NaN, too
            continue
        third, i, j = 0, 0, 0
        for corner in range(3):
            vertex = solid.faces[front, corner]
            if vertex == a:
                i = corner
            elif vertex == b:
                j = corner
            else:
                third = vertex
        cx, cy, _ = _project(eye, p[third, 0], p[third, 1], p[third, 2])
        n0, n1 = (by - ay) / length, -(bx - ax) / length
        if n0 * (cx - x) + n1 * (cy - y) > 0:
            n0, n1 = -n0, -n1
        reach = 0.0
        for r in _REACHES:
            if reach == 0 and _clear(triangle, x, y, n0, n1, r):
                reach = r
        if reach == 0:
            continue
        steps = int(2 * reach / _STEP)
        total = 0.0
        for k in range(steps):
            s = -reach + (k + 0.5) * _STEP
            total += _interpolated(rest, x + s * n0, y + s * n1)
        residual = total * _STEP
        ja = _shift(solid, a, pose, optics, v0, v1, v2, ahead, n0, n1) / 2
        jb = _shift(solid, b, pose, optics, v0, v1, v2, ahead, n0, n1) / 2
        w = weight * min(length, _MOST_LENGTH)
        _add_pair(blocks, front, i, j, ja, jb, residual, w)


@compiled(merged=True)
def _clear(triangle: npt.NDArray[np.int32], x: float, y: float, n0: float, n1: float, reach: float) -> bool:
    """Whether the mesh covers all pixels on the inner side of a rim, and none on the outer side."""
    for k in range(1, int(reach) + 1):
        s = reach * k / int(reach)
        if _covered(triangle, x + s * n0, y + s * n1) != 0 or _covered(triangle, x - s * n0, y - s * n1) != 1:
            return False
    return True


@compiled(merged=True)
def _shift(
    solid: Solid,
    vertex: int,
    pose: Floats,
    optics: Floats,
    v0: float,
    v1: float,
    v2: float,
    ahead: float,
    n0: float,
    n1: float,
) -> Any:
    """How many pixels a point (v relative to the camera) moves along n if it moves along the normal of a vertex."""
    g0, g1, g2 = solid.normals[vertex, 0], solid.normals[vertex, 1], solid.normals[vertex, 2]
    right = pose[0, 0] * v0 + pose[1, 0] * v1 + pose[2, 0] * v2
    up = pose[0, 1] * v0 + pose[1, 1] * v1 + pose[2, 1] * v2
    to_right = pose[0, 0] * g0 + pose[1, 0] * g1 + pose[2, 0] * g2
    to_up = pose[0, 1] * g0 + pose[1, 1] * g1 + pose[2, 1] * g2
    away = -(pose[0, 2] * g0 + pose[1, 2] * g1 + pose[2, 2] * g2)
    across = optics[0] * (to_right - right * away / ahead) / ahead
    down = -optics[1] * (to_up - up * away / ahead) / ahead
    return across * n0 + down * n1


@compiled(merged=True)
def _slot(i: int, j: int) -> int:
    """The place of entry i, j in a block."""
    low, high = min(i, j), max(i, j)
    return low * 2 + high if low < 2 else 5


@compiled(merged=True)
def _add_pair(blocks: Equations, face: int, i: int, j: int, ja: float, jb: float, residual: float, w: float) -> None:
    blocks.left[face, _slot(i, i)] += w * ja * ja
    blocks.left[face, _slot(j, j)] += w * jb * jb
    blocks.left[face, _slot(i, j)] += w * ja * jb
    blocks.right[face, i] += w * ja * residual
    blocks.right[face, j] += w * jb * residual


@compiled()
def add_smoothness(faces: Faces, weight: float, still: float, blocks: Equations) -> None:
    """Ask the vertices of each edge to move alike, and, with the weight `still`, each one to stay."""
    for f in range(len(faces)):
        for i in range(3):
            for j in range(i, 3):
                blocks.left[f, _slot(i, j)] += weight + still if i == j else -weight / 2


@compiled()
def solve_offsets(faces: Faces, count: int, blocks: Equations, rounds: int) -> Floats:
    """The offsets (count,) that solve the normal equations, by conjugate gradients with a diagonal preconditioner."""
    offset, rest, diagonal = np.zeros(count), np.zeros(count), np.zeros(count)
    for f in range(len(faces)):
        for i in range(3):
            rest[faces[f, i]] += blocks.right[f, i]
            diagonal[faces[f, i]] += blocks.left[f, _slot(i, i)]
    scaled, product = np.zeros(count), np.zeros(count)
    for v in range(count):
        if diagonal[v] > 0:
            scaled[v] = rest[v] / diagonal[v]
    way, power = scaled.copy(), 0.0
    for v in range(count):
        power += rest[v] * scaled[v]
    first = power
    for _ in range(rounds):
        if not power > first * _SOLVED * _SOLVED:
            break
        product[:] = 0
        for f in range(len(faces)):
            a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
            x, y, z = way[a], way[b], way[c]
            product[a] += blocks.left[f, 0] * x + blocks.left[f, 1] * y + blocks.left[f, 2] * z
            product[b] += blocks.left[f, 1] * x + blocks.left[f, 3] * y + blocks.left[f, 4] * z
            product[c] += blocks.left[f, 2] * x + blocks.left[f, 4] * y + blocks.left[f, 5] * z
        bent = 0.0
        for v in range(count):
            bent += way[v] * product[v]
        share, after = power / bent, 0.0
        for v in range(count):
            offset[v] += share * way[v]
            rest[v] -= share * product[v]
            if diagonal[v] > 0:
                scaled[v] = rest[v] / diagonal[v]
            after += rest[v] * scaled[v]
        for v in range(count):
            way[v] = scaled[v] + after / power * way[v]
        power = after
    return offset


@compiled()
def limit_offsets(solid: Solid, offset: Floats, most: float, least_cosine: float, rounds: int) -> None:
    """Shorten offsets in place: to `most` of the mean length of a vertex's edges, and until no face turns too far.

    A face keeps the cosine `least_cosine` to its normal; after `rounds` halvings its vertices stay.
    """
    p, count = solid.positions, len(offset)
    length, times = np.zeros(count), np.zeros(count)
    for e in range(len(solid.edges)):
        a, b = solid.edges[e, 0], solid.edges[e, 1]
        x, y, z = p[a, 0] - p[b, 0], p[a, 1] - p[b, 1], p[a, 2] - p[b, 2]
        own = np.sqrt(x * x + y * y + z * z)
        length[a] += own
        length[b] += own
        times[a] += 1
        times[b] += 1
    for v in range(count):
        top = most * length[v] / times[v] if times[v] > 0 else 0.0
        offset[v] = min(max(offset[v], -top), top)
    halved = np.zeros(count, np.int64)
    turned = True
    while turned:
        turned = False
        for f in range(len(solid.faces)):
            if not _turns(solid, offset, f, least_cosine):
                continue
            for i in range(3):
                v = solid.faces[f, i]
                halved[v] += 1
                if offset[v] != 0:
                    turned = True
                    offset[v] = offset[v] / 2 if halved[v] < rounds else 0.0


@compiled(merged=True)
def _turns(solid: Solid, offset: Floats, f: int, least_cosine: float) -> Any:
    p, n, faces = solid.positions, solid.normals, solid.faces
    a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
    u0 = (p[b, 0] + offset[b] * n[b, 0]) - (p[a, 0] + offset[a] * n[a, 0])
    u1 = (p[b, 1] + offset[b] * n[b, 1]) - (p[a, 1] + offset[a] * n[a, 1])
    u2 = (p[b, 2] + offset[b] * n[b, 2]) - (p[a, 2] + offset[a] * n[a, 2])
    w0 = (p[c, 0] + offset[c] * n[c, 0]) - (p[a, 0] + offset[a] * n[a, 0])
    w1 = (p[c, 1] + offset[c] * n[c, 1]) - (p[a, 1] + offset[a] * n[a, 1])
    w2 = (p[c, 2] + offset[c] * n[c, 2]) - (p[a, 2] + offset[a] * n[a, 2])
    x, y, z = u1 * w2 - u2 * w1, u2 * w0 - u0 * w2, u0 * w1 - u1 * w0
    along = x * solid.facing[f, 0] + y * solid.facing[f, 1] + z * solid.facing[f, 2]
    return along < least_cosine * np.sqrt(x * x + y * y + z * z)


@on_every_core
@compiled()
def add_texels(
    core: int,
    cores: int,
    solid: Solid,
    uvs: Singles,
    corners: Faces,
    texture: Singles,
    eye: SurfaceEye,
    triangle: npt.NDArray[np.int32],
    weights: Singles,
    image: Singles,
    weight: float,
    blocks: Equations,
) -> None:
    """Add one equation for each pixel and channel: the texture that shows there should have the photograph's colour.

    If a face moves along its normal, a ray meets another place of it, and another texel.
    uvs (u, 2), v down, of the corners (t, 3); texture (H, W, 3) in 0..1, which repeats; weights (H, W, 3) of the
    triangle's corners in each pixel; image (H, W, 4): colour and alpha in 0..1. Pixels that are not opaque are left
    out, and large residuals count less.
    """
    p, n, pose = solid.positions, solid.normals, eye.pose
    H, W = triangle.shape
    rows, columns = texture.shape[0], texture.shape[1]
    for y in range(H):
        for x in range(W):
            f = triangle[y, x]
            if f < 0 or f % cores != core or image[y, x, 3] < 0.999:
                continue
            a, b, c = solid.faces[f, 0], solid.faces[f, 1], solid.faces[f, 2]
            wa, wb, wc = np.float64(weights[y, x, 0]), np.float64(weights[y, x, 1]), np.float64(weights[y, x, 2])
            d0 = wa * p[a, 0] + wb * p[b, 0] + wc * p[c, 0] - pose[0, 3]
            d1 = wa * p[a, 1] + wb * p[b, 1] + wc * p[c, 1] - pose[1, 3]
            d2 = wa * p[a, 2] + wb * p[b, 2] + wc * p[c, 2] - pose[2, 3]
            far = np.sqrt(d0 * d0 + d1 * d1 + d2 * d2)
            d0, d1, d2 = d0 / far, d1 / far, d2 / far
            f0, f1, f2 = solid.facing[f, 0], solid.facing[f, 1], solid.facing[f, 2]
            along = d0 * f0 + d1 * f1 + d2 * f2
            if along > -_LEAST_COSINE:
                continue
            g0 = wa * n[a, 0] + wb * n[b, 0] + wc * n[c, 0]
            g1 = wa * n[a, 1] + wb * n[b, 1] + wc * n[c, 1]
            g2 = wa * n[a, 2] + wb * n[b, 2] + wc * n[c, 2]
            share = (f0 * g0 + f1 * g1 + f2 * g2) / along
            # Where on the unmoved face the ray arrives, for each world unit of the offset.
            s0, s1, s2 = share * d0 - g0, share * d1 - g1, share * d2 - g2
            e0, e1, e2 = p[b, 0] - p[a, 0], p[b, 1] - p[a, 1], p[b, 2] - p[a, 2]
            h0, h1, h2 = p[c, 0] - p[a, 0], p[c, 1] - p[a, 1], p[c, 2] - p[a, 2]
            ee, eh, hh = e0 * e0 + e1 * e1 + e2 * e2, e0 * h0 + e1 * h1 + e2 * h2, h0 * h0 + h1 * h1 + h2 * h2
            es, hs = e0 * s0 + e1 * s1 + e2 * s2, h0 * s0 + h1 * s1 + h2 * s2
            det = ee * hh - eh * eh
            if not det > 0:
                continue
            to_b, to_c = (hh * es - eh * hs) / det, (ee * hs - eh * es) / det
            ua, ub, uc = uvs[corners[f, 0], 0], uvs[corners[f, 1], 0], uvs[corners[f, 2], 0]
            va, vb, vc = uvs[corners[f, 0], 1], uvs[corners[f, 1], 1], uvs[corners[f, 2], 1]
            u = (wa * ua + wb * ub + wc * uc) * columns - 0.5
            v = (wa * va + wb * vb + wc * vc) * rows - 0.5
            du = (to_b * (ub - ua) + to_c * (uc - ua)) * columns
            dv = (to_b * (vb - va) + to_c * (vc - va)) * rows
            j, i = int(np.floor(u)), int(np.floor(v))
            fx, fy = u - j, v - i
            j0, j1, i0, i1 = j % columns, (j + 1) % columns, i % rows, (i + 1) % rows
            curve, pull = 0.0, 0.0
            for channel in range(3):
                t00, t01 = np.float64(texture[i0, j0, channel]), np.float64(texture[i0, j1, channel])
                t10, t11 = np.float64(texture[i1, j0, channel]), np.float64(texture[i1, j1, channel])
                colour = (t00 * (1 - fx) + t01 * fx) * (1 - fy) + (t10 * (1 - fx) + t11 * fx) * fy
                across = (t01 - t00) * (1 - fy) + (t11 - t10) * fy
                down = (t10 - t00) * (1 - fx) + (t11 - t01) * fx
                slope = across * du + down * dv
                residual = image[y, x, channel] - colour
                trust = 1 / (1 + residual * residual / (_OUTLIER * _OUTLIER))
                curve += trust * slope * slope
                pull += trust * slope * residual
            curve, pull = weight * curve, weight * pull
            blocks.left[f, 0] += curve * wa * wa
            blocks.left[f, 1] += curve * wa * wb
            blocks.left[f, 2] += curve * wa * wc
            blocks.left[f, 3] += curve * wb * wb
            blocks.left[f, 4] += curve * wb * wc
            blocks.left[f, 5] += curve * wc * wc
            blocks.right[f, 0] += pull * wa
            blocks.right[f, 1] += pull * wb
            blocks.right[f, 2] += pull * wc
