"""Splats -> whether they look upside down.

Things stand on their wide end: a floor under objects, four legs under a seat. The layers at the upper and at the lower
end of the splats are compared by the area over which their centres spread. A wide and a narrow end say nothing if the
wide one is much smaller than the whole, as in the crown of a tree.

docs/splats.md has how often this is right, silent and wrong. It is wrong for things on a narrow foot that were captured
without the ground, and for things that hang from a ceiling.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake.kernels.arrays import Floats
from nerfbake.scene.splats import Splats

_MOST, _LEAST = 20_000, 500  # splats that are looked at
_OPACITY = 0.05  # floaters are often thinner
_ENDS = 0.02  # share of the centres beyond each end of an axis that does not count as the middle
_LAYERS = (0.03, 0.06, 0.12)  # shares of the height
_BELOW = 0.15  # share of the height by which a layer reaches beyond the end of the middle
_ASIDE = 0.1  # share of the width
_FEW = 30  # centres in a layer
_RATIO = 4.0  # of the areas of the two ends, in all layers
_FOOTPRINT = 0.85  # of the wide end, compared with the area of all splats
_NOTHING = 1e-12


class Stand(NamedTuple):
    """The ends of splats along the vertical axis of their world.

    ratio      area of the lower layer over that of the upper one; of three layers the ratio that is nearest to 1, and 1
               if they do not agree which end is wider
    footprint  area of the wider end over that of all splats
    """

    ratio: float
    footprint: float

    @property
    def upside_down(self) -> bool:
        """True if the upper end is four times as wide in all layers, and about as wide as the whole."""
        return self.ratio <= 1 / _RATIO and self.footprint >= _FOOTPRINT


def measure_stand(splats: Splats) -> Stand:
    """Return how wide the ends of the splats are. -y points up. Too few splats have a ratio of 1.

    >>> import numpy as np
    >>> from nerfbake import Splats, measure_stand
    >>> x, z = np.meshgrid(np.linspace(-1, 1, 30), np.linspace(-1, 1, 30))
    >>> floor = np.stack([x.ravel(), 0 * x.ravel(), z.ravel()], axis=1)
    >>> post = np.stack([0.01 * floor[:, 0], np.linspace(0, 1, 900), 0.01 * floor[:, 2]], axis=1)
    >>> means = np.concatenate([floor, post]).astype(np.float32)
    >>> n, turn = len(means), np.array([[1, 0, 0, 0]], np.float32)
    >>> ones = np.ones(n, np.float32)
    >>> hanging = Splats(means, means * 0, turn.repeat(n, 0), ones, np.zeros((n, 1, 3), np.float32))
    >>> measure_stand(hanging).upside_down, measure_stand(hanging.flipped()).upside_down
    (True, False)
    """
    kept = np.flatnonzero(splats.opacity > _OPACITY)
    kept = kept[:: max(1, len(kept) // _MOST)]
    if len(kept) < _LEAST:
        return Stand(1.0, 0.0)
    means = splats.means[kept].astype(np.float64)
    low, high = (np.percentile(means, 100 * share, axis=0) for share in (_ENDS, 1 - _ENDS))
    size = high - low
    if not (size > 0).all():
        return Stand(1.0, 0.0)
    height = (high[1] - means[:, 1]) / size[1]  # 0 at the lower end, 1 at the upper one
    beside = _ASIDE * size
    inside = ((means > low - beside) & (means < high + beside))[:, [0, 2]].all(axis=1)
    across, height = means[inside][:, [0, 2]], height[inside]
    whole = _area(across, np.ones(len(across), bool))
    ratios, footprints = [], []
    for layer in _LAYERS:
        lower = _area(across, (height < layer) & (height > -_BELOW))
        upper = _area(across, (height > 1 - layer) & (height < 1 + _BELOW))
        ratios.append(lower / upper)
        footprints.append(max(lower, upper) / whole)
    agreed = all(ratio > 1 for ratio in ratios) or all(ratio < 1 for ratio in ratios)
    ratio = min(ratios, key=lambda each: max(each, 1 / each)) if agreed else 1.0
    return Stand(ratio, footprints[1])


def _area(points: Floats, chosen: npt.NDArray[np.bool_]) -> float:
    """The area over which points spread: the root of the determinant of their covariance; 1e-12 for few points."""
    if np.count_nonzero(chosen) < _FEW:
        return _NOTHING
    x, z = (points[chosen] - points[chosen].mean(axis=0)).T
    square = (x * x).mean() * (z * z).mean() - (x * z).mean() ** 2
    return float(np.sqrt(max(square, _NOTHING**2)))
