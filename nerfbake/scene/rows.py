"""Rows of values in a scene, as an array or computed on demand."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from nerfbake import memory


class Rows(Protocol):
    """(n, D) values, or an object that computes them: a slice of rows, or all with np.asarray()."""

    @property
    def shape(self) -> tuple[int, ...]: ...

    @property
    def dtype(self) -> np.dtype[Any]: ...

    @property
    def nbytes(self) -> int: ...

    def __getitem__(self, rows: slice, /) -> npt.NDArray[Any]: ...


class RowsOfNodes(Rows, Protocol):
    """Rows of an octree's nodes."""

    def take(self, rows: npt.NDArray[Any], axis: int) -> npt.NDArray[Any]:
        """Return (m, D) values of these leaves, in this order; axis is 0."""


class LazyRows:
    """A dataclass field of Rows, which are converted to an array on first access.

    The original Rows are stored under another attribute name.
    """

    def __init__(self, name: str, given: str) -> None:
        self._name, self._given = name, given

    def __get__(self, scene: Any, owner: type) -> npt.NDArray[Any]:
        if scene is None:
            raise AttributeError(self._name)  # so that the field has no default
        rows = scene.__dict__[self._given]
        if not isinstance(rows, np.ndarray):
            memory.grown(scene, f"{self._name}, made at once,", rows.nbytes)
        data = np.asarray(rows)
        self.__set__(scene, data)
        return data

    def __set__(self, scene: Any, rows: Rows) -> None:
        scene.__dict__[self._given] = rows
