"""NumPy's .npy: a header that declares dtype, order and shape, and the array's bytes; alone, or a member of an .npz."""

from __future__ import annotations

import ast
import io
import re
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from nerfbake.errors import InvalidFile, Problem

MAX_HEADER = 10_000
MAX_DIMENSIONS = 8


class _Stream(Protocol):
    def read(self, size: int, /) -> bytes: ...


def read_header(key: str, stream: _Stream) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    """Shape, Fortran order and dtype as an .npy file declares them, in a Python dict literal."""
    magic = stream.read(8)
    if magic[:6] != np.lib.format.MAGIC_PREFIX or magic[6:7] not in (b"\1", b"\2", b"\3"):
        raise InvalidFile(Problem(key, f"starts with {magic[:6]!r}", "an array (.npy, version 1 to 3)"))
    size = int.from_bytes(stream.read(2 if magic[6] == 1 else 4), "little")
    if size > MAX_HEADER:
        raise InvalidFile(Problem(key, f"has a header of {size:,} bytes", f"{MAX_HEADER:,} at most"))
    text = stream.read(size).decode("latin-1")
    try:
        header = ast.literal_eval(text.strip())
        shape, fortran, descr = header["shape"], header["fortran_order"], header["descr"]
    except (ValueError, TypeError, SyntaxError, KeyError, MemoryError, RecursionError):
        raise InvalidFile(Problem(key, f"has the header {text[:60]!r}", "descr, fortran_order and shape")) from None
    if isinstance(descr, str) and "O" in descr:
        raise InvalidFile(Problem(key, "holds Python objects (pickle)", "numbers or text; nerfbake never unpickles"))
    if not (isinstance(descr, str) and re.fullmatch(r"[<>|=]?(f[248]|[iu][1248]|U[0-9]{1,4})", descr)):
        raise InvalidFile(Problem(key, f"has dtype {str(descr)[:60]}", "whole numbers, floats or text"))
    if not (isinstance(shape, tuple) and all(type(edge) is int and 0 <= edge < 1 << 48 for edge in shape)):
        raise InvalidFile(Problem(key, f"has shape {str(shape)[:60]}", "whole numbers from 0"))
    if len(shape) > MAX_DIMENSIONS:
        raise InvalidFile(Problem(key, f"has {len(shape)} dimensions", f"{MAX_DIMENSIONS} at most"))
    return shape, fortran is True, np.dtype(descr)


def npy_pieces(array: npt.NDArray[Any]) -> tuple[bytes, memoryview]:
    """An array as .npy: its header and its little-endian bytes."""
    array = np.asarray(array, array.dtype.newbyteorder("<"), order="C")
    head = io.BytesIO()
    np.lib.format.write_array_header_1_0(head, np.lib.format.header_data_from_array_1_0(array))
    return head.getvalue(), array.reshape(-1).view(np.uint8).data
