"""Choose the splats of a scene: the box around them without those far outside, its voxels, and their up axis."""

from __future__ import annotations

from dataclasses import replace
from math import ceil
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake.errors import InvalidScene, Problem
from nerfbake.kernels.arrays import Points
from nerfbake.kernels.soundness import plural
from nerfbake.scene.splats import Splats, Up

OPACITY_MIN = 1 / 255  # pictures of splats leave out what is thinner
_FROM_Y_DOWN = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0]])  # x right, z forward to x right, z up
_STRAYS = 0.01  # share of the splats at each end of an axis that do not count as the middle
_BEYOND = 0.5  # widths of the middle by which the box may reach beyond it, at each end
# Share of the splats that may be too small for the voxels, and voxels across a standard deviation. A splat in voxels of
# 1, 1/2, 1/4 and 1/6 of its standard deviation has 39.3, 46.8, 40.7 and 38.1 dB after a fit to 36 pictures; a fog of
# 563 equal ones has 39.2 and 39.1 dB in 1 and 1/2.
_SMALL, _ACROSS = 0.05, 2
_REACH = 3  # standard deviations of a usual splat around the centres


def inner_box(splats: Splats, *, opacity_min: float = OPACITY_MIN) -> Points:
    """Return the lowest and highest corner (2, 3) of the box around the splats without those far outside.

    The middle is what 98 % of the centres span along each axis. A splat is far outside if its centre lies more than
    half the middle's width away from it. Real captures have single splats hundreds of widths away, and single splats
    that are larger than the scene, so the box reaches around the others' centres by the usual size of a splat. Raises
    InvalidScene if no splat has this opacity.
    """
    held = _opaque(splats, opacity_min)
    centres = splats.means[held].astype(np.float64)
    ordered = np.sort(centres, axis=0)
    strays = int(_STRAYS * len(ordered))
    low, high = ordered[strays], ordered[-1 - strays]
    inside = (np.abs(centres - (low + high) / 2) <= (0.5 + _BEYOND) * (high - low)).all(axis=1)
    kept = centres[inside] if inside.any() else centres
    reach = _usual_reach(splats, held)
    return np.stack([kept.min(axis=0) - reach, kept.max(axis=0) + reach])


def whole_box(splats: Splats, *, opacity_min: float = OPACITY_MIN) -> Points:
    """Return the lowest and highest corner (2, 3) of the box around all centres, and a usual splat around them."""
    held = _opaque(splats, opacity_min)
    centres, reach = splats.means[held].astype(np.float64), _usual_reach(splats, held)
    return np.stack([centres.min(axis=0) - reach, centres.max(axis=0) + reach])


def finest_voxels(splats: Splats, box: Points, *, most: int) -> int:
    """Return the number of voxels along the longest edge of a box that these splats need, 1 to `most`.

    Voxels are half as wide as the splats that 95 % are larger than. A lower resolution blurs them, and a higher one
    takes time and memory, and is worse after the same fit.
    """
    narrow = np.sort(splats.scales.min(axis=1))[int(_SMALL * splats.n)]
    edge = float((box[1] - box[0]).max())
    return most if edge * _ACROSS >= most * float(narrow) else max(ceil(edge * _ACROSS / float(narrow)), 1)


class SplatCut(NamedTuple):
    """splats: those that are kept, in their order. notes: what was left out, a line for each reason."""

    splats: Splats
    notes: tuple[str, ...]


def cut_splats(splats: Splats, box: Points, *, opacity_min: float = OPACITY_MIN) -> SplatCut:
    """Return the splats of this opacity whose centre is in a box. Raises InvalidScene if none is."""
    opaque = splats.opacity >= opacity_min
    kept = opaque & ((splats.means >= box[0]) & (splats.means <= box[1])).all(axis=1)
    if not kept.any():
        corners = ", ".join(f"{value:.4g}" for value in box.ravel().tolist())
        allowed = "a box with centres of splats that are not thinner than `opacity_min`"
        raise InvalidScene(Problem("the box", f"is {corners}, without a splat", allowed))
    count, thick = int(np.count_nonzero(kept)), int(np.count_nonzero(opaque))
    cut = splats.take(kept)
    notes = []
    if count < thick:
        corners = ",".join(f"{value:.4g}" for value in box.ravel().tolist())
        notes.append(f"leaves out {plural(thick - count, 'splat')} of {splats.n:,} outside the box {corners}")
    if thick < splats.n:
        notes.append(f"leaves out {plural(splats.n - thick, 'splat')} of an opacity below {opacity_min:.2g}")
    return SplatCut(cut if notes else splats, tuple(notes))


def with_z_up(splats: Splats, up: Up | None) -> Splats:
    """Return the splats rotated so that this axis of their world becomes z; None: as they are."""
    return splats if up in (None, "z") else replace(splats.with_up(up).transformed(_FROM_Y_DOWN), up="z")


def _opaque(splats: Splats, opacity_min: float) -> npt.NDArray[np.bool_]:
    held = splats.opacity >= opacity_min
    if not held.any():
        found = f"have opacities up to {splats.opacity.max():.3g}"
        raise InvalidScene(Problem("the splats", found, f"an opacity of {opacity_min:.3g} or more"))
    return held


def _usual_reach(splats: Splats, held: npt.NDArray[np.bool_]) -> float:
    largest = np.sort(splats.scales[held].max(axis=1))
    return _REACH * float(largest[len(largest) // 2])
