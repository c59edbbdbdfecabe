"""Fuse depths of many views, and the opacity of a field's cells, in the bricks of samples around its surface.

Source of the fused distances: Curless and Levoy, "A volumetric method for building complex models from range images"
(1996).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from nerfbake.kernels.arrays import Coords, Floats, Ints, Singles
from nerfbake.kernels.compiled import compiled_exp_parts
from nerfbake.kernels.jit import borrowed, compiled
from nerfbake.kernels.march.cells import EMPTY, Cells, descend
from nerfbake.kernels.parallel import on_every_core
from nerfbake.kernels.surface.samples import CUBE, place_of


class DepthViews(NamedTuple):
    """V pictures of depths, all in arrays of the largest one's size.

    depth  (V, H, W) along the ray, in world units; inf where nothing is seen
    size   (V, 2) height and width in use
    pose   (V, 3, 4) camera to world, OpenGL axes
    optics (V, 4) fx, fy, cx, cy of a pinhole
    """

    depth: Singles
    size: Ints
    pose: Floats
    optics: Floats


@on_every_core
@compiled()
def fuse_depths(
    core: int,
    cores: int,
    places: Coords,
    world: Floats,
    views: DepthViews,
    truncation: float,
    fused: Singles,
    nearest: Singles,
) -> None:
    """Fill fused (b, 64) with the mean, over views, of the distance in front of what they see, -1 to 1 truncations.

    A view that sees something more than a truncation in front of a sample has no vote; without any vote a sample is
    -1, inside. Fills nearest (b, 64), too: the largest distance in front of what a view sees, in truncations, clamped
    to -1 .. 1. places (b, 3): bricks; world (3, 4): the world of the lattice.
    """
    places, world, views, fused, nearest = borrowed((places, world, views, fused, nearest))
    for brick in range(core, len(places), cores):
        for cell in range(CUBE):
            x, y, z = place_of(places, brick, cell)
            w0 = world[0, 0] * x + world[0, 1] * y + world[0, 2] * z + world[0, 3]
            w1 = world[1, 0] * x + world[1, 1] * y + world[1, 2] * z + world[1, 3]
            w2 = world[2, 0] * x + world[2, 1] * y + world[2, 2] * z + world[2, 3]
            total, votes, most = 0.0, 0.0, -1.0
            for view in range(len(views.depth)):
                seen, ahead = _ahead(views, view, w0, w1, w2, truncation)
                if seen and ahead > -1:
                    total += min(ahead, 1.0)
                    votes += 1
                    most = max(most, min(ahead, 1.0))
            fused[brick, cell] = total / votes if votes else -1.0
            nearest[brick, cell] = most


@compiled(merged=True)
def _ahead(views: DepthViews, view: int, w0: float, w1: float, w2: float, truncation: float) -> Any:
    """Whether a view sees a point's surroundings, and how far the point is in front of what it sees there."""
    pose, optics = views.pose, views.optics
    v0, v1, v2 = w0 - pose[view, 0, 3], w1 - pose[view, 1, 3], w2 - pose[view, 2, 3]
    back = -(pose[view, 0, 2] * v0 + pose[view, 1, 2] * v1 + pose[view, 2, 2] * v2)
    if back <= 0:
        return False, 0.0
    right = pose[view, 0, 0] * v0 + pose[view, 1, 0] * v1 + pose[view, 2, 0] * v2
    up = pose[view, 0, 1] * v0 + pose[view, 1, 1] * v1 + pose[view, 2, 1] * v2
    column = optics[view, 0] * right / back + optics[view, 2] - 0.5
    row = -optics[view, 1] * up / back + optics[view, 3] - 0.5
    H, W = views.size[view, 0], views.size[view, 1]
    if not (0 <= column < W - 1 and 0 <= row < H - 1):
        return False, 0.0
    x, y = int(column), int(row)
    fx, fy = column - x, row - y
    a, b = np.float64(views.depth[view, y, x]), np.float64(views.depth[view, y, x + 1])
    c, d = np.float64(views.depth[view, y + 1, x]), np.float64(views.depth[view, y + 1, x + 1])
    far = np.sqrt(v0 * v0 + v1 * v1 + v2 * v2)
    if max(a, b, c, d) - min(a, b, c, d) < 2 * truncation:
        found = (a * (1 - fx) + b * fx) * (1 - fy) + (c * (1 - fx) + d * fx) * fy
    elif fy < 0.5:
        found = a if fx < 0.5 else b
    else:
        found = c if fx < 0.5 else d
    return True, (found - far) / truncation


@on_every_core
@compiled()
def sample_opacity(
    core: int,
    cores: int,
    places: Coords,
    cells: Cells,
    densities: Singles,
    cell_place: Floats,
    step: int,
    width: float,
    out: Singles,
) -> None:
    """Fill out (b, 64) with the opacity of one lattice step of the field around each sample.

    cell_place (3,): the cell position of sample (0, 0, 0) minus half a step; step: cells between samples; width: of a
    step, in world units. The density is the mean of the step^3 cells around a sample.
    """
    places, cells, densities, cell_place, out = borrowed((places, cells, densities, cell_place, out))
    for brick in range(core, len(places), cores):
        for cell in range(CUBE):
            x, y, z = place_of(places, brick, cell)
            x, y, z = int(cell_place[0]) + step * x, int(cell_place[1]) + step * y, int(cell_place[2]) + step * z
            total = 0.0
            for part in range(step * step * step):
                i, j, k = x + part // (step * step), y + part // step % step, z + part % step
                if 0 <= i < cells.edge and 0 <= j < cells.edge and 0 <= k < cells.edge:
                    slot, _ = descend(cells, (i, j, k))
                    if slot != EMPTY:
                        total += densities[-2 - slot]
            whole, rest = compiled_exp_parts(-total / (step * step * step) * width)
            out[brick, cell] = 1 - (whole + whole * rest)
