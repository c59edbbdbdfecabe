"""Rows of values that a scene holds, as an array or still to be made."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from nerfbake import memory


class Rows(Protocol):
    """(n, D) values, or what makes them: some rows at a time, or all with np.asarray()."""

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
        """(m, D) those of these leaves, in this order; axis is 0."""


class MadeOnce:
    """A field of rows: those that are still to be made become an array when the field is first read.

    As they were given they are kept under another name.
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
