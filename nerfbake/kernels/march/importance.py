"""How much of any ray each leaf keeps at most: what may be left out of a scene without anybody seeing it."""

from __future__ import annotations

import numpy as np

from nerfbake.kernels.arrays import Floats, Singles
from nerfbake.kernels.jit import compiled
from nerfbake.kernels.march.cells import EMPTY, Cells, descend, lowest
from nerfbake.kernels.march.traversal import beyond, compiled_exp_parts, span, within


@compiled()
def collect_maxima(
    cells: Cells,
    sigma: Singles,
    box: Floats,
    origin: Floats,
    directions: Floats,
    cut: float,
    largest: Singles,
    alpha: Singles,
) -> None:
    """Raises each leaf's largest transmittance times alpha to what these rays see of it.

    box, origin, directions and cut as kernels.march.traversal has them; sigma and largest (leaves,), which the caller
    keeps from other threads; alpha (m,) becomes what each ray lost on its way. A maximum does not depend on the order
    of rays, so that what several threads collect is the same as what one does.
    """
    low0, low1, low2 = box[0, 0], box[0, 1], box[0, 2]
    high0, high1, high2 = box[1, 0] - 1, box[1, 1] - 1, box[1, 2] - 1
    for ray in range(len(directions)):
        start, end, scale = span(box, origin, directions, ray, np.inf)
        d0, d1, d2 = directions[ray, 0] / scale, directions[ray, 1] / scale, directions[ray, 2] / scale
        o0, o1, o2 = origin[0] + start * d0, origin[1] + start * d1, origin[2] + start * d2
        i0 = 1 / d0 if d0 != 0 else np.inf
        i1 = 1 / d1 if d1 != 0 else np.inf
        i2 = 1 / d2 if d2 != 0 else np.inf
        through, t, end, world = 1.0, 0.0, end - start, 1 / scale
        x, y, z = within(o0, low0, high0), within(o1, low1, high1), within(o2, low2, high2)
        while t < end:
            slot, level = descend(cells, x, y, z)
            width = cells.width[level]
            l0, l1, l2 = lowest(cells, level, x), lowest(cells, level, y), lowest(cells, level, z)
            exit0 = ((l0 + width if d0 > 0 else l0) - o0) * i0 if d0 != 0 else np.inf
            exit1 = ((l1 + width if d1 > 0 else l1) - o1) * i1 if d1 != 0 else np.inf
            exit2 = ((l2 + width if d2 > 0 else l2) - o2) * i2 if d2 != 0 else np.inf
            ahead = max(min(exit0, exit1, exit2), t)
            if slot != EMPTY:
                row = -2 - slot
                whole, rest = compiled_exp_parts(-sigma[row] * (min(ahead, end) - t) * world)
                kept = whole + whole * rest
                weight = np.float32(through * (1 - kept))
                largest[row] = max(largest[row], weight)
                through *= kept
                if through < cut:
                    break
            t = ahead
            x, y, z, axis = beyond(l0, l1, l2, width, exit0, exit1, exit2, o0, o1, o2, d0, d1, d2, t)
            if not (low0 <= x <= high0 if axis == 0 else low1 <= y <= high1 if axis == 1 else low2 <= z <= high2):
                break
        alpha[ray] = 1 - through
