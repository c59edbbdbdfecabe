"""What an octree's nodes hold, as an array or still to be made."""

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


class NodeData:
    """The field node_data: rows that are still to be made become an array when it is first read."""

    def __get__(self, octree: Any, owner: type) -> npt.NDArray[Any]:
        if octree is None:
            raise AttributeError("node_data")  # so that the field has no default
        rows = octree.node_rows
        if not isinstance(rows, np.ndarray):
            memory.grown(octree, "node_data, made at once,", rows.nbytes)
        data = np.asarray(rows)
        self.__set__(octree, data)
        return data

    def __set__(self, octree: Any, rows: Rows) -> None:
        octree.__dict__["node_rows"] = rows
