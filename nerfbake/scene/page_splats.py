"""Splats as a page carries them: rounded to whole numbers, along a Morton curve."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from nerfbake.errors import InvalidScene, Problem
from nerfbake.kernels.arrays import Floats, Points
from nerfbake.kernels.maths.elementary import cast, exp
from nerfbake.kernels.soundness import plural
from nerfbake.scene.compact_repr import CompactRepr
from nerfbake.scene.splats import BASES, Splats, Up

SCALES = 1024  # codes of a scale
SCALE_STEP, SCALE_ONE = 1 / 16, 640  # of the logarithm; the code of scale 1. The same step as in .spz
TURN = 127  # the code of a quaternion's component sqrt(1/2) is twice this, and of 0 once
OPACITIES = 255
COLOUR_STEP = 1 / 64  # of the first coefficient
REST_STEP = 1 / 32  # of the others
_OTHERS = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])  # the components besides the largest one


@dataclass(frozen=True, eq=False, repr=False)
class PageSplats(CompactRepr):
    """Splats as whole numbers, n rows of each array.

    places  (n, 3) int32; the centre is box[0] + step places, in world units
    scales  (n, 3) uint16, 0 to 1023: e^((scale - 640) / 16) world units
    turns   (n, 4) uint8: the number of the quaternion's largest component, which is positive, and the three others, in
            order: component = (turn - 127) / (127 sqrt 2)
    opacity  (n,) uint8, in 255ths
    colours  (n, 3) int16, in 64ths: the first coefficients
    rest    (n, B - 1, 3) int8, in 32nds: the other coefficients
    box     (2, 3) float64: around the scene without strays, in world units; step: in world units
    antialiased, up, origin  as those of Splats

    >>> import numpy as np
    >>> from nerfbake import Splats, build_page_splats
    >>> one, turn = np.full((1, 3), 0.1, np.float32), np.array([[1, 0, 0, 0]], np.float32)
    >>> page = build_page_splats(Splats(one, one, turn, np.ones(1, np.float32), one[:, None]))
    >>> page.scales.tolist(), page.turns.tolist(), page.opacity.tolist()
    ([[603, 603, 603]], [[0, 127, 127, 127]], [255])
    """

    places: npt.NDArray[np.int32]
    scales: npt.NDArray[np.uint16]
    turns: npt.NDArray[np.uint8]
    opacity: npt.NDArray[np.uint8]
    colours: npt.NDArray[np.int16]
    rest: npt.NDArray[np.int8]
    box: Points
    step: float
    antialiased: bool
    up: Up | None
    origin: Floats

    def __post_init__(self) -> None:
        n, B = len(self.places), 1 + self.rest.shape[1] if self.rest.ndim == 3 else 0
        if not n or B not in BASES:
            found = f"are {n:,} with {B} coefficients"
            raise InvalidScene(Problem("the page's splats", found, f"at least one, with {', '.join(map(str, BASES))}"))
        for name, shape, dtype in (
            ("places", (n, 3), np.int32),
            ("scales", (n, 3), np.uint16),
            ("turns", (n, 4), np.uint8),
            ("opacity", (n,), np.uint8),
            ("colours", (n, 3), np.int16),
            ("rest", (n, B - 1, 3), np.int8),
        ):
            array = getattr(self, name)
            if array.shape != shape or array.dtype != dtype:
                found = f"has shape {array.shape}, dtype {array.dtype}"
                raise InvalidScene(Problem(f"the page splats' {name}", found, f"{shape} {np.dtype(dtype)}"))
        if self.scales.max() >= SCALES or self.turns[:, 0].max() > 3:
            raise InvalidScene(Problem("the page splats' scales or turns", "are too large", f"{SCALES - 1} and 3"))

    @property
    def n(self) -> int:
        """Number of splats."""
        return len(self.places)

    @property
    def B(self) -> int:
        """Coefficients of each colour."""
        return 1 + int(self.rest.shape[1])

    def __str__(self) -> str:
        return f"{plural(self.n, 'splat')} of SH degree {BASES.index(self.B)}"

    def restored(self) -> Splats:
        """Return the splats that the page draws, in its order."""
        n = self.n
        means = self.box[0] + self.step * self.places.astype(np.float64)
        sizes = exp((np.arange(SCALES) - SCALE_ONE) * SCALE_STEP)
        others = (self.turns[:, 1:].astype(np.float64) - TURN) / (TURN * np.sqrt(2.0))
        square = (others * others).sum(axis=1)
        quats = np.empty((n, 4))
        np.put_along_axis(quats, self.turns[:, :1].astype(np.int64), np.sqrt(np.maximum(1 - square, 0))[:, None], 1)
        np.put_along_axis(quats, _OTHERS[self.turns[:, 0]], others, 1)
        quats /= np.sqrt((quats * quats).sum(axis=1, keepdims=True))
        sh = np.empty((n, self.B, 3), np.float32)
        sh[:, 0] = self.colours * np.float32(COLOUR_STEP)
        sh[:, 1:] = self.rest * np.float32(REST_STEP)
        return Splats(
            cast(means, np.float32),
            cast(sizes, np.float32)[self.scales],
            cast(quats, np.float32),
            cast(self.opacity / OPACITIES, np.float32),
            sh,
            self.antialiased,
            up=self.up,
            origin=self.origin,
        )


def others_of(largest: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """Return the numbers (n, 3) of a quaternion's components besides the largest one (n,)."""
    return np.asarray(_OTHERS[largest], np.int64)
