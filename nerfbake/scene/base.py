"""Base class of the scenes that can be stored in a file, with the checks that all of them share."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from nerfbake.errors import InvalidScene, Problem
from nerfbake.kernels.soundness import all_within, count_problem
from nerfbake.scene.compact_repr import CompactRepr, notebook_html

MAX_WORLD = 1e15  # largest coordinate, edge and 1 / edge in world units: their squares stay finite


class Scene(CompactRepr):
    """A scene. The constructor checks shapes and dtypes; the methods report an invalid structure and invalid values."""

    def _repr_html_(self) -> str | None:
        """A page, or facts and a thumbnail, for a notebook cell; None for a scene that is a picture itself."""
        return notebook_html(self)

    def structure_problems(self) -> list[Problem]:
        """Problems that prevent reading the scene."""
        return []

    def value_problems(self) -> list[Problem]:
        """Values that cannot be used. The structure must be valid."""
        return []

    def unread_problems(self) -> list[Problem]:
        """Parts of the file that nerfbake cannot read; the scene is valid without them."""
        return []

    def problems(self) -> list[Problem]:
        """All problems. Values are checked only if the structure is valid."""
        return [*self.unread_problems(), *(self.structure_problems() or self.value_problems())]

    def require_sound(self) -> None:
        """Raise InvalidScene with the first structural problem, if there is one."""
        if problems := self.structure_problems():
            raise InvalidScene(problems[0])

    def require_usable(self) -> None:
        """Raise InvalidScene with the first problem of the structure, or else of the values, if there is one."""
        if problems := self.structure_problems() or self.value_problems():
            raise InvalidScene(problems[0])


def require_shape(name: str, array: npt.NDArray[Any], shape: tuple[int, ...], dtype: type[np.generic]) -> None:
    """Raise InvalidScene unless the array has this shape and dtype. name: the array's name in the error."""
    if array.shape != shape or array.dtype != dtype:
        found = f"has shape {array.shape}, dtype {array.dtype}"
        raise InvalidScene(Problem(name, found, f"{shape} {np.dtype(dtype)}"))


def set_vectors(scene: Scene, *names: str) -> None:
    """Replace these attributes by copies (3,) float64. A single number stands for all three."""
    for name in names:
        value = np.broadcast_to(np.asarray(getattr(scene, name), np.float64), 3).copy()
        object.__setattr__(scene, name, value)


def place_problems(name: str, place: npt.NDArray[np.float64]) -> list[Problem]:
    """Coordinates that are not finite, or larger than MAX_WORLD."""
    return count_problem(name, ~(np.abs(place) <= MAX_WORLD), place, f"a finite number, up to {MAX_WORLD:g}")


def edge_problems(name: str, edges: npt.NDArray[np.float64]) -> list[Problem]:
    """Lengths (or 1 / length) that are not positive, or outside 1 / MAX_WORLD to MAX_WORLD."""
    wrong = ~((edges >= 1 / MAX_WORLD) & (edges <= MAX_WORLD))
    return count_problem(name, wrong, edges, f"a finite number above 0, {1 / MAX_WORLD:g} to {MAX_WORLD:g}")


def number_problems(
    name: str, values: npt.NDArray[Any], *, where: npt.NDArray[np.bool_] | None = None, most: float = np.inf
) -> list[Problem]:
    """NaN, infinity and magnitudes above `most` among the values.

    where: a mask, broadcast to the values, of those to check; None: all.
    """
    if all_within(values, most):
        return []
    finite = np.isfinite(values)
    large = finite & (np.abs(values) > min(most, float(np.finfo(values.dtype).max)))
    if where is not None:
        finite, large = finite | ~where, large & where
    too_much = count_problem(name, large, values, f"a number up to {most:g}")
    return count_problem(name, ~finite, values, "a finite number") + too_much
