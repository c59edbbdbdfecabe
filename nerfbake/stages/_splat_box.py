"""The box around splats, without those that lie far outside."""

from __future__ import annotations

import numpy as np

from nerfbake.errors import InvalidScene, Problem
from nerfbake.kernels.arrays import Points
from nerfbake.scene.splats import Splats

OPACITY_MIN = 1 / 255  # pictures of splats leave out what is thinner
_STRAYS = 0.01  # share of the splats at each end of an axis that do not count as the middle
_BEYOND = 0.5  # widths of the middle by which the box may reach beyond it, at each end
_REACH = 3  # standard deviations of a usual splat around the centres


def inner_box(splats: Splats, *, opacity_min: float = OPACITY_MIN) -> Points:
    """Return the lowest and highest corner (2, 3) of the box around the splats without those far outside.

    The middle is what 98 % of the centres span along each axis. A splat is far outside if its centre lies more than
    half the middle's width away from it. Real captures have single splats hundreds of widths away, and single splats
    that are larger than the scene, so the box reaches around the others' centres by the usual size of a splat. Raises
    InvalidScene if no splat has this opacity.
    """
    held = splats.opacity >= opacity_min
    if not held.any():
        found = f"have opacities up to {splats.opacity.max():.3g}"
        raise InvalidScene(Problem("the splats", found, f"an opacity of {opacity_min:.3g} or more"))
    centres = splats.means[held].astype(np.float64)
    largest = np.sort(splats.scales[held].max(axis=1))
    ordered = np.sort(centres, axis=0)
    strays = int(_STRAYS * len(ordered))
    low, high = ordered[strays], ordered[-1 - strays]
    inside = (np.abs(centres - (low + high) / 2) <= (0.5 + _BEYOND) * (high - low)).all(axis=1)
    kept = centres[inside] if inside.any() else centres
    reach = _REACH * float(largest[len(largest) // 2])
    return np.stack([kept.min(axis=0) - reach, kept.max(axis=0) + reach])


def inside_box(splats: Splats, box: Points) -> int:
    """Return the number of splats whose centre is in a box."""
    return int(np.count_nonzero(((splats.means >= box[0]) & (splats.means <= box[1])).all(axis=1)))
