"""What every scene that a file can hold answers: is it sound, and what is wrong with it?"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from nerfbake.errors import InvalidScene, Problem
from nerfbake.kernels.soundness import all_within, count_problem
from nerfbake.scene.shown import Shown, described

MAX_WORLD = 1e15  # world units of a place or an edge, and of what one over an edge is: their squares are numbers, too


class Scene(Shown):
    """Shapes and dtypes are checked as a scene is made; a structure or values that cannot be right are told here."""

    def _repr_html_(self) -> str | None:
        """Facts and a thumbnail, in the cell of a notebook; None where it is a picture itself."""
        return None if hasattr(self, "_repr_png_") else described(self)

    def structure_problems(self) -> list[Problem]:
        """What keeps the scene from being read at all."""
        return []

    def value_problems(self) -> list[Problem]:
        """Values that nobody can use; the structure must be sound."""
        return []

    def unread_problems(self) -> list[Problem]:
        """What the file holds beside the scene that nobody here can read; the scene itself is none the worse for it."""
        return []

    def problems(self) -> list[Problem]:
        """Everything that is wrong; values are looked at once the structure is sound."""
        return [*self.unread_problems(), *(self.structure_problems() or self.value_problems())]

    def require_sound(self) -> None:
        """Raises InvalidScene with the first structural problem, if there is one."""
        if problems := self.structure_problems():
            raise InvalidScene(problems[0])

    def require_usable(self) -> None:
        """Raises InvalidScene with the first problem of the structure, or else of the values, if there is one."""
        if problems := self.structure_problems() or self.value_problems():
            raise InvalidScene(problems[0])


def require_shape(name: str, array: npt.NDArray[Any], shape: tuple[int, ...], dtype: type[np.generic]) -> None:
    """Raises InvalidScene unless the array has this shape and this number type. name: for the error."""
    if array.shape != shape or array.dtype != dtype:
        found = f"has shape {array.shape}, dtype {array.dtype}"
        raise InvalidScene(Problem(name, found, f"{shape} {np.dtype(dtype)}"))


def place_problems(name: str, place: npt.NDArray[np.float64]) -> list[Problem]:
    """Coordinates that are not finite, or too far away to calculate with."""
    return count_problem(name, ~(np.abs(place) <= MAX_WORLD), place, f"a finite number, up to {MAX_WORLD:g}")


def edge_problems(name: str, edges: npt.NDArray[np.float64]) -> list[Problem]:
    """Lengths (or one over a length) that are not above 0, too short or too long to calculate with."""
    wrong = ~((edges >= 1 / MAX_WORLD) & (edges <= MAX_WORLD))
    return count_problem(name, wrong, edges, f"a finite number above 0, {1 / MAX_WORLD:g} to {MAX_WORLD:g}")


def number_problems(
    name: str, values: npt.NDArray[Any], *, where: npt.NDArray[np.bool_] | None = None, most: float = np.inf
) -> list[Problem]:
    """Of all values, or of those `where` (broadcast to them) is True: NaN and infinity, and what is above `most`."""
    if all_within(values, most):
        return []
    finite = np.isfinite(values)
    large = finite & (np.abs(values) > min(most, float(np.finfo(values.dtype).max)))
    if where is not None:
        finite, large = finite | ~where, large & where
    too_much = count_problem(name, large, values, f"a number up to {most:g}")
    return count_problem(name, ~finite, values, "a finite number") + too_much
