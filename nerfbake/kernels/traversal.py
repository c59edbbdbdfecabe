"""Rays through a sparse N^3 tree of constant cells: the one marcher, whatever the tree was made from.

    slots (n, N^3) int32: cells [x][y][z] of each node    >= 0  row of the child
                                                            -1  empty space
                                                         <= -2  a leaf, whose values are row -2 - slot
Source of the rules: spec/n3tree.md, "How it is rendered".
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from numba import prange

from nerfbake.kernels.jit import compiled

EMPTY = -1
STEP = 1e-5  # behind a cell's exit, in tree units: into the next cell, whatever the rounding
MAX_STEPS = 100_000


@compiled(parallel=True)
def march(
    slots: npt.NDArray[np.int32],
    N: int,
    values: npt.NDArray[np.float32],
    origin: npt.NDArray[np.float64],
    directions: npt.NDArray[np.float64],
    basis: npt.NDArray[np.float32],
    cut: float,
    out: npt.NDArray[np.float32],
) -> None:
    """Front to back, until the ray leaves the cube [0, 1]^3 or lets less than `cut` through.

    origin (3,) and directions (m, 3) in tree units, a direction's length being that of one world unit; basis (m, B);
    values (leaves, 3 B + 1), density per world unit last. out (m, 5): colour weighted by opacity, alpha, and the sum of
    opacity times distance. Within a cell the density is constant, so opacity and distance are exact.
    """
    B = basis.shape[1]
    for ray in prange(len(directions)):
        d0, d1, d2 = directions[ray, 0], directions[ray, 1], directions[ray, 2]
        scale = np.sqrt(d0 * d0 + d1 * d1 + d2 * d2)
        d0, d1, d2 = d0 / scale, d1 / scale, d2 / scale
        o0, o1, o2 = origin[0], origin[1], origin[2]
        i0 = 1 / d0 if d0 != 0 else np.inf
        i1 = 1 / d1 if d1 != 0 else np.inf
        i2 = 1 / d2 if d2 != 0 else np.inf
        t, end = _span(o0, o1, o2, d0, d1, d2, i0, i1, i2)
        through, red, green, blue, far = 1.0, 0.0, 0.0, 0.0, 0.0
        for _ in range(MAX_STEPS):
            if t >= end:
                break
            # Down from the root to the cell that holds this point.
            p0 = min(max(o0 + t * d0, 0.0), 1 - 1e-12)
            p1 = min(max(o1 + t * d1, 0.0), 1 - 1e-12)
            p2 = min(max(o2 + t * d2, 0.0), 1 - 1e-12)
            l0, l1, l2, width, node = 0.0, 0.0, 0.0, 1.0, 0
            while True:
                width /= N
                c0, c1, c2 = int((p0 - l0) / width), int((p1 - l1) / width), int((p2 - l2) / width)
                c0, c1, c2 = min(c0, N - 1), min(c1, N - 1), min(c2, N - 1)
                l0, l1, l2 = l0 + c0 * width, l1 + c1 * width, l2 + c2 * width
                node = slots[node, (c0 * N + c1) * N + c2]
                if node < 0:
                    break
            exit0 = ((l0 + width if d0 > 0 else l0) - o0) * i0 if d0 != 0 else np.inf
            exit1 = ((l1 + width if d1 > 0 else l1) - o1) * i1 if d1 != 0 else np.inf
            exit2 = ((l2 + width if d2 > 0 else l2) - o2) * i2 if d2 != 0 else np.inf
            ahead = max(min(exit0, exit1, exit2), t) + STEP
            if node != EMPTY:
                row = -2 - node
                sigma = values[row, 3 * B]
                length = (min(ahead, end) - t) / scale
                depth = sigma * length
                alpha = -np.expm1(-depth)
                weight = through * alpha
                r, g, b = 0.0, 0.0, 0.0
                for k in range(B):
                    y = basis[ray, k]
                    r += y * values[row, k]
                    g += y * values[row, B + k]
                    b += y * values[row, 2 * B + k]
                red += weight / (1 + np.exp(-r))
                green += weight / (1 + np.exp(-g))
                blue += weight / (1 + np.exp(-b))
                # The mean distance within the cell, of what is lost there.
                far += weight * t / scale + through * (alpha - depth * (1 - alpha)) / sigma
                through *= 1 - alpha
                if through < cut:
                    break
            t = ahead
        out[ray, 0], out[ray, 1], out[ray, 2], out[ray, 3], out[ray, 4] = red, green, blue, 1 - through, far


@compiled(inline=True)
def _span(o0: Any, o1: Any, o2: Any, d0: Any, d1: Any, d2: Any, i0: Any, i1: Any, i2: Any) -> tuple[float, float]:
    """Where a ray enters and leaves the cube; it starts at its origin."""
    start, end = 0.0, np.inf
    for o, d, i in ((o0, d0, i0), (o1, d1, i1), (o2, d2, i2)):
        if d != 0:
            a, b = -o * i, (1 - o) * i
            start, end = max(start, min(a, b)), min(end, max(a, b))
        elif o < 0 or o >= 1:
            end = -1.0
    return start, end
