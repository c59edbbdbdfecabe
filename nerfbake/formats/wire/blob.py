"""An array as one block of bytes, with its dtype and shape beside it: how every wire stores a large array."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from nerfbake.kernels.parallel import ahead

_ROWS = 1 << 13  # made at a time: a megabyte or so


class Blob(NamedTuple):
    """An array as its little-endian bytes, C order, with dtype and shape beside them."""

    dtype: str  # NumPy's spelling: <i4, <f4, <f2
    shape: tuple[int, ...]
    data: memoryview


def blob_of(values: npt.NDArray[Any]) -> Blob:
    """The array's own memory where it is little-endian and contiguous already, else a copy."""
    little = np.ascontiguousarray(values, values.dtype.newbyteorder("<"))
    return Blob(little.dtype.newbyteorder("<").str, values.shape, little.reshape(-1).view(np.uint8).data)


class Rows(Protocol):
    """An array, or what makes it, some rows at a time."""

    @property
    def shape(self) -> tuple[int, ...]: ...

    @property
    def dtype(self) -> np.dtype[Any]: ...

    def __getitem__(self, rows: slice, /) -> npt.NDArray[Any]: ...


def row_pieces(rows: Rows) -> Iterator[memoryview]:
    """The rows' little-endian bytes in order; what is not made yet is made while the part before it is written."""
    if isinstance(rows, np.ndarray):
        yield blob_of(rows).data
        return
    starts = range(0, rows.shape[0], _ROWS)
    yield from ahead(blob_of(rows[start : start + _ROWS]).data for start in starts)


class Record(Protocol):
    """A struct or table that is read by its fields' numbers."""

    def text(self, index: int, /) -> str: ...

    def array(self, index: int, dtype: str, /) -> npt.NDArray[Any]: ...


def array_fields(values: npt.NDArray[Any]) -> list[Any]:
    """The fields of the schemas' Array: dtype, shape, bytes."""
    blob = blob_of(values)
    return [blob.dtype, np.array(blob.shape, np.uint64), np.frombuffer(blob.data, np.uint8)]


def blob_in(record: Record | None) -> Blob | None:
    """What such an Array holds, where there is one."""
    if record is None:
        return None
    return Blob(record.text(0), tuple(record.array(1, "<u8").tolist()), record.array(2, "u1").data)
