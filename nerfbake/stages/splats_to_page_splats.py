"""Splats -> the whole numbers that a page carries, and the page."""

from __future__ import annotations

import numpy as np

from nerfbake import memory
from nerfbake.kernels.arrays import Floats, Ints
from nerfbake.kernels.maths.elementary import exp
from nerfbake.kernels.octree.lookup import dilate
from nerfbake.scene.page_splats import (
    COLOUR_STEP,
    OPACITIES,
    REST_STEP,
    SCALE_ONE,
    SCALE_STEP,
    SCALES,
    TURN,
    PageSplats,
    others_of,
)
from nerfbake.scene.splats import Splats
from nerfbake.stages.picture import scene_frame

_ACROSS = 1 << 17  # steps along the longest edge of the box without strays
_MOST = 1 << 30  # steps from the middle of that box to the farthest splat
_LEVEL = 12  # bits of a Morton code along an axis
_BYTES = 400  # a splat, while it is rounded


def build_page_splats(splats: Splats) -> PageSplats:
    """Return splats as a page carries them, along a Morton curve.

    Centres are rounded to a 131,072th of the scene's longest edge, more if single splats are thousands of edges away;
    scales by at most 3 %, components of quaternions to 1/359, opacities to 1/510. First coefficients are rounded to
    1/128 and others to 1/64, and both are clamped, to 512 and 4. Raises InvalidScene, MemoryLimit.

    >>> import numpy as np
    >>> from nerfbake import Splats, build_page_splats
    >>> places = np.float32([[0, 0, 0], [9, 0, 0], [1, 0, 0]])
    >>> ones, turns = np.ones((3, 3), np.float32), np.tile(np.float32([1, 0, 0, 0]), (3, 1))
    >>> page = build_page_splats(Splats(places, ones, turns, ones[:, 0], np.zeros((3, 4, 3), np.float32)))
    >>> print(page)
    3 splats of SH degree 1
    >>> np.round(page.restored().means[:, 0]).tolist()
    [0.0, 1.0, 9.0]
    """
    splats.require_usable()
    with memory.lent("the page's splats", _BYTES * splats.n):
        means = splats.means.astype(np.float64)
        box, _ = scene_frame(splats)
        low, high = box
        edge = max(float((high - low).max()), 1e-30)
        far = float(np.abs(means - low).max())
        step = max(edge / _ACROSS, far / _MOST)
        places = np.rint((means - low) / step).astype(np.int32)
        order = _along((means - low) / edge)
        sizes = exp((np.arange(SCALES - 1) + 0.5 - SCALE_ONE) * SCALE_STEP)  # between one code and the next
        largest, turns = _turns(splats.quats[order].astype(np.float64))
        rest = np.rint(splats.sh[order, 1:].astype(np.float64) / REST_STEP).clip(-127, 127)
        return PageSplats(
            places[order],
            np.searchsorted(sizes, splats.scales[order]).astype(np.uint16),
            np.concatenate([largest[:, None], turns], axis=1).astype(np.uint8),
            np.rint(splats.opacity[order].astype(np.float64) * OPACITIES).astype(np.uint8),
            np.rint(splats.sh[order, 0].astype(np.float64) / COLOUR_STEP).clip(-32767, 32767).astype(np.int16),
            rest.astype(np.int8),
            box,
            step,
            splats.antialiased,
            splats.up,
            splats.origin,
        )


def _along(share: Floats) -> Ints:
    """Return the order of points (n, 3) along a Morton curve through the unit cube, and outside at its walls."""
    cells = (share * 2**_LEVEL).clip(0, 2**_LEVEL - 1).astype(np.int64)
    return np.argsort(sum(dilate(cells[:, axis]) << axis for axis in range(3)), kind="stable")


def _turns(quats: Floats) -> tuple[Ints, Floats]:
    """Return the largest component (n,) of each quaternion, and the codes (n, 3) of the others."""
    largest = np.abs(quats).argmax(axis=1)
    sign = np.where(np.take_along_axis(quats, largest[:, None], 1) < 0, -1.0, 1.0)
    others = np.take_along_axis(quats, others_of(largest), 1) * sign
    return largest, (np.rint(others * (np.sqrt(2.0) * TURN)) + TURN).clip(0, 2 * TURN)
