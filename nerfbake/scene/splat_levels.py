"""Levels of detail of Gaussian splats."""

from __future__ import annotations

from dataclasses import dataclass

from nerfbake.errors import InvalidScene, Problem
from nerfbake.kernels.soundness import plural
from nerfbake.scene.base import Scene
from nerfbake.scene.splats import Splats


@dataclass(frozen=True, eq=False, repr=False)
class SplatLevels(Scene):
    """The same scene as splats several times, the finest first. A viewer shows each part of space in one of them.

    levels  one or more, each with the same origin

    >>> import numpy as np
    >>> from nerfbake import SplatLevels, Splats
    >>> one, turn = np.ones((2, 3), np.float32), np.array([[1, 0, 0, 0]] * 2, np.float32)
    >>> fine = Splats(one, one, turn, np.ones(2, np.float32), np.zeros((2, 4, 3), np.float32))
    >>> print(SplatLevels((fine, fine.with_degree(0))))
    2 levels of 2 and 2 splats
    """

    levels: tuple[Splats, ...]

    def __post_init__(self) -> None:
        if not self.levels:
            raise InvalidScene(Problem("the levels of splats", "are none", "one or more"))
        if any((level.origin != self.levels[0].origin).any() for level in self.levels):
            raise InvalidScene(Problem("the levels of splats", "have several origins", "one"))

    @property
    def notes(self) -> tuple[str, ...]:
        """What of the file was ignored, and assumptions, one line each."""
        return tuple(dict.fromkeys(note for level in self.levels for note in level.notes))

    def value_problems(self) -> list[Problem]:
        """Values that cannot be drawn."""
        return [problem for level in self.levels for problem in level.value_problems()]

    def __str__(self) -> str:
        *most, last = (f"{level.n:,}" for level in self.levels)
        counts = f"{', '.join(most)} and {last}" if most else last
        return f"{plural(len(self.levels), 'level')} of {counts} splats"
