"""How alike a picture and its neighbours are if what a pixel shows lies on one of some planes, and a smooth choice.

The planes are parallel to the picture. A plane is given by its inverse depth, so 0 is the plane at infinity.
Sources: plane sweeping (Collins, 1996); the smooth choice is semi-global matching (Hirschmueller, 2008).
"""

from __future__ import annotations

import numpy as np

from nerfbake.kernels.arrays import Bits, Floats, Singles
from nerfbake.kernels.fit.bricks import Whole
from nerfbake.kernels.jit import borrowed, compiled
from nerfbake.kernels.parallel import on_every_core

UNSEEN = -1.0  # likeness where no other picture shows the pixel's place
_REACH = 3  # pixels around a pixel that are compared with it, in both directions
_LEAST = 25  # of these 49 pixels must be in both pictures
_FLAT = 1e-7  # product of two variances, as of noise of 4 or 5 of 255, that counts as no texture
_BEST = 2  # neighbours that count at a pixel, the most alike ones: something may hide the place in the others
_NEXT, _FAR = 0.15, 0.6  # costs if neighbouring pixels lie on planes beside each other, and on others
_SUMS = 6


@on_every_core
@compiled()
def compare_planes(
    core: int,
    cores: int,
    grey: Singles,
    others: Singles,
    used: Bits,
    turns: Floats,
    moves: Floats,
    planes: Floats,
    alike: Singles,
) -> None:
    """Fill alike (P, H, W): the mean of the highest normalised cross-correlations with other pictures, or UNSEEN.

    grey (H, W); others, used (K, h, w): the other pictures, and the pixels of them that may be compared. turns
    (K, 3, 3), moves (K, 3): a pixel (u, v) at the inverse depth w is at turn (u, v, 1) + w move, in homogeneous
    coordinates, in an other picture. planes (P,): inverse depths. All pictures of pinholes.
    """
    grey, others, used, turns, moves, planes, alike = borrowed((grey, others, used, turns, moves, planes, alike))
    height, width = grey.shape
    warped, both = np.zeros((height, width), np.float32), np.zeros((height, width), np.float32)
    columns, best = np.zeros((_SUMS, width)), np.zeros((_BEST, height, width), np.float32)
    for plane in range(core, len(planes), cores):
        best[:] = UNSEEN
        for other in range(len(others)):
            _warp(others, used, turns, moves, other, planes[plane], warped, both)
            _correlate(grey, warped, both, columns, best)
        for y in range(height):
            for x in range(width):
                total, count = 0.0, 0
                for k in range(_BEST):
                    if best[k, y, x] > UNSEEN:
                        total, count = total + best[k, y, x], count + 1
                alike[plane, y, x] = total / count if count else UNSEEN


@compiled()
def _warp(
    others: Singles, used: Bits, turns: Floats, moves: Floats, k: Whole, inverse: float, warped: Singles, both: Singles
) -> None:
    """Interpolate an other picture where the pixels' places on a plane are. both: 1 where it shows them, else 0."""
    height, width = warped.shape
    high, wide = others.shape[1:]
    for y in range(height):
        for x in range(width):
            u, v = x + 0.5, y + 0.5
            z = turns[k, 2, 0] * u + turns[k, 2, 1] * v + turns[k, 2, 2] + inverse * moves[k, 2]
            warped[y, x] = both[y, x] = 0
            if not z > 1e-9:
                continue
            a = (turns[k, 0, 0] * u + turns[k, 0, 1] * v + turns[k, 0, 2] + inverse * moves[k, 0]) / z - 0.5
            b = (turns[k, 1, 0] * u + turns[k, 1, 1] * v + turns[k, 1, 2] + inverse * moves[k, 1]) / z - 0.5
            if not (0 <= a < wide - 1 and 0 <= b < high - 1):
                continue
            i, j = int(a), int(b)
            if used[k, j, i] and used[k, j, i + 1] and used[k, j + 1, i] and used[k, j + 1, i + 1]:
                upper = others[k, j, i] + (a - i) * (others[k, j, i + 1] - others[k, j, i])
                lower = others[k, j + 1, i] + (a - i) * (others[k, j + 1, i + 1] - others[k, j + 1, i])
                warped[y, x] = upper + (b - j) * (lower - upper)
                both[y, x] = 1


@compiled()
def _correlate(grey: Singles, warped: Singles, both: Singles, columns: Floats, best: Singles) -> None:
    """Insert the cross-correlation around each pixel into the pixel's best ones, in descending order."""
    height, width = grey.shape
    columns[:] = 0
    for y in range(-_REACH, height):
        if y + _REACH < height:
            _add_row(grey, warped, both, y + _REACH, 1.0, columns)
        if y - _REACH > 0:
            _add_row(grey, warped, both, y - _REACH - 1, -1.0, columns)
        if y < 0:
            continue
        count = a = aa = g = gg = ag = 0.0
        for x in range(-_REACH, width):
            ahead, behind = x + _REACH, x - _REACH - 1
            if ahead < width:
                count, a, aa = count + columns[0, ahead], a + columns[1, ahead], aa + columns[2, ahead]
                g, gg, ag = g + columns[3, ahead], gg + columns[4, ahead], ag + columns[5, ahead]
            if behind >= 0:
                count, a, aa = count - columns[0, behind], a - columns[1, behind], aa - columns[2, behind]
                g, gg, ag = g - columns[3, behind], gg - columns[4, behind], ag - columns[5, behind]
            if x < 0 or both[y, x] == 0 or count < _LEAST:
                continue
            spread = max(aa - a * a / count, 0.0) * max(gg - g * g / count, 0.0)
            found = np.float32((ag - a * g / count) / np.sqrt(spread + count * count * _FLAT))
            for k in range(_BEST):
                if found > best[k, y, x]:
                    found, best[k, y, x] = best[k, y, x], found


@compiled()
def _add_row(grey: Singles, warped: Singles, both: Singles, y: Whole, sign: float, columns: Floats) -> None:
    for x in range(grey.shape[1]):
        a, g = np.float64(warped[y, x]), np.float64(grey[y, x]) * both[y, x]
        columns[0, x] += sign * both[y, x]
        columns[1, x] += sign * a
        columns[2, x] += sign * a * a
        columns[3, x] += sign * g
        columns[4, x] += sign * g * g
        columns[5, x] += sign * a * g


def smooth_costs(costs: Singles) -> Singles:
    """Return (H, W, P) float32: the costs of the planes for each pixel, and of the cheapest ways there from four sides.

    costs (H, W, P): 0 for a plane on which the pictures are alike, 1 for one on which they are not.
    """
    totals = np.zeros_like(costs)
    _add_ways(costs, totals)
    _add_ways(costs.transpose(1, 0, 2), totals.transpose(1, 0, 2))
    return totals


@on_every_core
@compiled()
def _add_ways(core: int, cores: int, costs: Singles, totals: Singles) -> None:
    """Add the costs of the ways along each row, from both of its ends."""
    costs, totals = borrowed((costs, totals))
    height, width, planes = costs.shape
    last, here = np.zeros(planes + 2, np.float32), np.zeros(planes + 2, np.float32)
    near, far = np.float32(_NEXT), np.float32(_FAR)
    for row in range(core, height, cores):
        for side in range(2):
            last[:] = 0
            least = np.float32(0)
            for step in range(width):
                x = width - 1 - step if side else step
                # Entry 0 and the last one are beside the planes.
                last[0] = last[planes + 1] = least + far
                lowest = np.float32(np.inf)
                for p in range(planes):
                    way = min(min(last[p + 1], min(last[p], last[p + 2]) + near), least + far)
                    here[p + 1] = costs[row, x, p] + way - least
                    totals[row, x, p] += here[p + 1]
                    lowest = min(lowest, here[p + 1])
                last, here = here, last
                least = lowest
