"""Gaussian splats: ellipsoids with an opacity and spherical harmonics for their colours."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from nerfbake.errors import InvalidScene, Problem
from nerfbake.kernels.maths.elementary import cast
from nerfbake.kernels.soundness import count_problem, plural
from nerfbake.scene.base import MAX_WORLD, Scene, number_problems, require_shape

BASES = (1, 4, 9, 16, 25)  # coefficients of each colour at degree 0, 1, 2, 3, 4
_UNIT = 1e-3  # how far from 1 the length of a quaternion may be


@dataclass(frozen=True, eq=False, repr=False)
class Splats(Scene):
    """Gaussian splats, n rows of each array.

    means        (n, 3) float32, centres in world units
    scales       (n, 3) float32, standard deviations along the splat's own axes, world units, 0 or more
    quats        (n, 4) float32, unit quaternions w, x, y, z: the rotation from the splat's own axes to the world
    opacity      (n,) float32, 0 to 1, at the centre
    sh           (n, B, 3) float32, spherical harmonics in svox's order and signs, red, green, blue last; B is 1, 4, 9,
                 16 or 25. The colour is max(0, SH + 1/2), sRGB, for the direction from the camera to the splat.
    antialiased  the splats were trained with compensation of their opacity for the blur of a pixel
    dropped      rows of the file that were left out because they cannot be drawn

    The world is that of the training program: a .ply holds it as it is, and the reader of .spz turns its y and z axes.

    >>> import numpy as np
    >>> from nerfbake import Splats
    >>> one = np.ones((1, 3), np.float32)
    >>> turn = np.array([[1, 0, 0, 0]], np.float32)
    >>> print(Splats(one, one, turn, np.ones(1, np.float32), np.zeros((1, 4, 3), np.float32)))
    1 splat of SH degree 1
    """

    means: npt.NDArray[np.float32]
    scales: npt.NDArray[np.float32]
    quats: npt.NDArray[np.float32]
    opacity: npt.NDArray[np.float32]
    sh: npt.NDArray[np.float32]
    antialiased: bool = False
    dropped: int = 0

    def __post_init__(self) -> None:
        n = len(self.means)
        B = self.sh.shape[1] if self.sh.ndim == 3 else 0
        if not n:
            raise InvalidScene(Problem("the splats", "have no rows", "at least one splat"))
        if B not in BASES:
            found = f"has shape {self.sh.shape}"
            raise InvalidScene(Problem("sh", found, f"(n, B, 3), B one of {', '.join(map(str, BASES))}"))
        for name, array, shape in (
            ("means", self.means, (n, 3)),
            ("scales", self.scales, (n, 3)),
            ("quats", self.quats, (n, 4)),
            ("opacity", self.opacity, (n,)),
            ("sh", self.sh, (n, B, 3)),
        ):
            require_shape(name, array, shape, np.float32)

    @property
    def n(self) -> int:
        """Number of splats."""
        return len(self.means)

    @property
    def B(self) -> int:
        """Coefficients of each colour."""
        return int(self.sh.shape[1])

    @property
    def degree(self) -> int:
        """Degree of the spherical harmonics, 0 to 4."""
        return BASES.index(self.B)

    def value_problems(self) -> list[Problem]:
        """Values that cannot be drawn."""
        problems = number_problems("means", self.means, most=MAX_WORLD)
        wrong = ~((self.scales >= 0) & (self.scales <= MAX_WORLD))
        problems += count_problem("scales", wrong, self.scales, f"0 to {MAX_WORLD:g}")
        lengths = np.sqrt((self.quats.astype(np.float64) ** 2).sum(axis=1))
        problems += count_problem("quats' lengths", ~(np.abs(lengths - 1) <= _UNIT), lengths, "1")
        outside = ~((self.opacity >= 0) & (self.opacity <= 1))
        problems += count_problem("opacity", outside, self.opacity, "0 to 1")
        return problems + number_problems("sh", self.sh)

    def unread_problems(self) -> list[Problem]:
        """The dropped rows."""
        if not self.dropped:
            return []
        found = f"had {plural(self.dropped, 'row')} that cannot be drawn, which were left out"
        return [Problem("the file", found, "finite numbers, and quaternions other than 0")]

    def __str__(self) -> str:
        return f"{plural(self.n, 'splat')} of SH degree {self.degree}"


def splats_of_rows(
    means: npt.NDArray[Any],
    scales: npt.NDArray[Any],
    quats: npt.NDArray[Any],
    opacity: npt.NDArray[Any],
    sh: npt.NDArray[Any],
    *,
    antialiased: bool = False,
) -> Splats:
    """Make splats of a file's rows: any floats, and quaternions of any length.

    A row that cannot be drawn is dropped and counted: it has a number that is not finite, a coordinate or scale above
    MAX_WORLD, or a quaternion of length 0. Raises InvalidScene if these are more than half.
    """
    n = len(means)
    if not n:
        raise InvalidScene(Problem("the splats", "have no rows", "at least one splat"))
    quats = quats.astype(np.float64)
    with np.errstate(over="ignore", invalid="ignore"):
        lengths = np.sqrt((quats * quats).sum(axis=1))
        good = (np.abs(means) <= MAX_WORLD).all(axis=1) & (scales >= 0).all(axis=1) & (scales <= MAX_WORLD).all(axis=1)
        good &= (lengths > 1e-30) & (lengths < 1e30) & (opacity >= 0) & (opacity <= 1)
        good &= (np.abs(sh) <= np.finfo(np.float32).max).all(axis=(1, 2))
    dropped = n - int(np.count_nonzero(good))
    if 2 * dropped > n:
        found = f"have {plural(dropped, 'row')} of {n:,} that cannot be drawn"
        raise InvalidScene(Problem("the splats", found, "at most half: finite numbers, quaternions other than 0"))
    if dropped:
        means, scales, quats, opacity, sh = (array[good] for array in (means, scales, quats, opacity, sh))
        lengths = lengths[good]
    return Splats(
        _float32(means),
        _float32(scales),
        _float32(quats / lengths[:, None]),
        _float32(opacity),
        _float32(sh),
        antialiased,
        dropped,
    )


def _float32(values: npt.NDArray[Any]) -> npt.NDArray[np.float32]:
    return np.ascontiguousarray(cast(values, np.float32))
