"""Find the texels that triangles in texture space show."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from nerfbake.kernels.jit import compiled

REACH = 1.0  # texels around a triangle that a bilinear lookup inside it can read


def covered_texels(
    uvs: npt.NDArray[np.float32], faces: npt.NDArray[np.uint32], H: int, W: int
) -> npt.NDArray[np.bool_]:
    """(H, W) bool: texels whose centre is in a triangle or within a texel of it; uvs (v, 2) in 0..1, v down."""
    covered = np.zeros((H, W), np.bool_)
    # In texels, so that texel centres have integer coordinates.
    _cover(uvs.astype(np.float64) * (W, H) - 0.5, faces, covered)
    return covered


@compiled()
def _cover(points: npt.NDArray[np.float64], faces: npt.NDArray[np.uint32], covered: npt.NDArray[np.bool_]) -> None:
    H, W = covered.shape
    edges = np.empty((3, 3))
    for face in faces:
        a, b, c = points[face[0]], points[face[1]], points[face[2]]
        turn = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
        side = 1.0 if turn >= 0 else -1.0
        for corner in range(3):
            p, q = points[face[corner]], points[face[(corner + 1) % 3]]
            dx, dy = q[0] - p[0], q[1] - p[1]
            length = max(np.sqrt(dx * dx + dy * dy), 1e-12)
            # The signed distance of (x, y) from this edge, inside positive: edges . (x, y, 1).
            edges[corner, 0], edges[corner, 1] = -dy / length * side, dx / length * side
            edges[corner, 2] = -(edges[corner, 0] * p[0] + edges[corner, 1] * p[1])
        left = max(int(np.ceil(min(a[0], b[0], c[0]) - REACH)), 0)
        right = min(int(np.floor(max(a[0], b[0], c[0]) + REACH)), W - 1)
        top = max(int(np.ceil(min(a[1], b[1], c[1]) - REACH)), 0)
        bottom = min(int(np.floor(max(a[1], b[1], c[1]) + REACH)), H - 1)
        for y in range(top, bottom + 1):
            for x in range(left, right + 1):
                inside = True
                for corner in range(3):
                    inside &= edges[corner, 0] * x + edges[corner, 1] * y + edges[corner, 2] >= -REACH
                if inside:
                    covered[y, x] = True


@compiled()
def paint(
    places: npt.NDArray[np.float32],
    faces: npt.NDArray[np.uint32],
    values: npt.NDArray[np.float32],
    out: npt.NDArray[np.float32],
    known: npt.NDArray[np.bool_],
) -> None:
    """Fill the texels whose centre is in a triangle with its value (t, C); places (v, 2) in texel centres."""
    H, W = known.shape
    for f in range(len(faces)):
        a, b, c = places[faces[f, 0]], places[faces[f, 1]], places[faces[f, 2]]
        left, right = int(np.ceil(min(a[0], b[0], c[0]))), int(np.floor(max(a[0], b[0], c[0])))
        top, bottom = int(np.ceil(min(a[1], b[1], c[1]))), int(np.floor(max(a[1], b[1], c[1])))
        for y in range(max(top, 0), min(bottom, H - 1) + 1):
            for x in range(max(left, 0), min(right, W - 1) + 1):
                u = (b[0] - a[0]) * (y - a[1]) - (b[1] - a[1]) * (x - a[0])
                v = (c[0] - b[0]) * (y - b[1]) - (c[1] - b[1]) * (x - b[0])
                w = (a[0] - c[0]) * (y - c[1]) - (a[1] - c[1]) * (x - c[0])
                if (u >= 0 and v >= 0 and w >= 0) or (u <= 0 and v <= 0 and w <= 0):
                    known[y, x] = True
                    for channel in range(out.shape[2]):
                        out[y, x, channel] = values[f, channel]
