"""Large arrays as blobs: one block of bytes with a dtype and a shape. All wire formats store large arrays this way."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from nerfbake.kernels.parallel import prefetched

_ROWS = 1 << 13  # computed at a time: about a megabyte


class Blob(NamedTuple):
    """The little-endian bytes of an array in C order, with its dtype and shape."""

    dtype: str  # NumPy's spelling: <i4, <f4, <f2
    shape: tuple[int, ...]
    data: memoryview


def blob_of(values: npt.NDArray[Any]) -> Blob:
    """Return the array as a blob; copied unless it is little-endian and contiguous."""
    little = np.ascontiguousarray(values, values.dtype.newbyteorder("<"))
    return Blob(little.dtype.newbyteorder("<").str, values.shape, little.reshape(-1).view(np.uint8).data)


class RowSource(Protocol):
    """An array, or an object that computes the rows of one on demand."""

    @property
    def shape(self) -> tuple[int, ...]: ...

    @property
    def dtype(self) -> np.dtype[Any]: ...

    def __getitem__(self, rows: slice, /) -> npt.NDArray[Any]: ...


def row_pieces(rows: RowSource) -> Iterator[memoryview]:
    """Yield the little-endian bytes of the rows in order; the next rows are computed while the caller writes."""
    if isinstance(rows, np.ndarray):
        yield blob_of(rows).data
        return
    starts = range(0, rows.shape[0], _ROWS)
    yield from prefetched(blob_of(rows[start : start + _ROWS]).data for start in starts)


class Record(Protocol):
    """A struct or table whose fields are read by number."""

    def text(self, index: int, /) -> str: ...

    def array(self, index: int, dtype: str, /) -> npt.NDArray[Any]: ...


def array_fields(values: npt.NDArray[Any]) -> list[Any]:
    """Return the fields of the type Array in the schemas: dtype, shape, bytes."""
    blob = blob_of(values)
    return [blob.dtype, np.array(blob.shape, np.uint64), np.frombuffer(blob.data, np.uint8)]


def blob_in(record: Record | None) -> Blob | None:
    """Return the blob of a record of the type Array; None if there is no record."""
    if record is None:
        return None
    return Blob(record.text(0), tuple(record.array(1, "<u8").tolist()), record.array(2, "u1").data)
