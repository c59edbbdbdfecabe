"""Headers of NumPy's .npy files and .npz members: dtype, order and shape; the bytes of the array follow."""

from __future__ import annotations

import io
import math
import re
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from nerfbake.errors import InvalidFile, Problem

MAX_HEADER = 10_000
MAX_DIMENSIONS = 8
MAX_BYTES = 1 << 48

# A dict literal with three keys in any order. Python 2 wrote integers as 12L. Possessive quantifiers (*+) prevent
# backtracking.
_NUMBER = re.compile(r"[0-9]+")
_TUPLE = r"\(\s*+(?:[0-9]{1,15}+L?\s*+(?:,\s*+|(?=\))))*+\)"
_VALUE = rf"True|False|'[^'\\]*+'|\"[^\"\\]*+\"|\[[^\]]*+\]|{_TUPLE}"
_ITEM = re.compile(rf"['\"](descr|fortran_order|shape)['\"]\s*+:\s*+({_VALUE})")
_HEADER = re.compile(rf"\s*+\{{\s*+(?:{_ITEM.pattern}\s*+(?:,\s*+|(?=\}})))*+\}}\s*+")
_DTYPE = re.compile(r"[<>|=]?(f[248]|[iu][1248]|U[1-9][0-9]{0,3})")


class _Stream(Protocol):
    def read(self, size: int, /) -> bytes: ...


def read_header(key: str, stream: _Stream) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    """Read the header of an .npy file, a Python dict literal: shape, Fortran order and dtype."""
    magic = stream.read(8)
    if magic[:6] != np.lib.format.MAGIC_PREFIX or magic[6:7] not in (b"\1", b"\2", b"\3"):
        raise InvalidFile(Problem(key, f"starts with {magic[:6]!r}", "an array (.npy, version 1 to 3)"))
    size = int.from_bytes(stream.read(2 if magic[6] == 1 else 4), "little")
    if size > MAX_HEADER:
        raise InvalidFile(Problem(key, f"has a header of {size:,} bytes", f"{MAX_HEADER:,} at most"))
    text = stream.read(size).decode("latin-1")
    items = dict(_ITEM.findall(text)) if _HEADER.fullmatch(text) else {}
    if set(items) != {"descr", "fortran_order", "shape"}:
        raise InvalidFile(Problem(key, f"has the header {text[:60]!r}", "descr, fortran_order and shape"))
    descr, shape = items["descr"].strip("'\""), tuple(map(int, _NUMBER.findall(items["shape"])))
    if "O" in descr:
        raise InvalidFile(Problem(key, "holds Python objects (pickle)", "numbers or text; nerfbake never unpickles"))
    if not _DTYPE.fullmatch(descr):
        raise InvalidFile(Problem(key, f"has dtype {descr[:60]}", "whole numbers, floats or text"))
    if len(shape) > MAX_DIMENSIONS:
        raise InvalidFile(Problem(key, f"has {len(shape)} dimensions", f"{MAX_DIMENSIONS} at most"))
    dtype = np.dtype(descr)
    # NumPy multiplies all edges except those of 0.
    if dtype.itemsize * math.prod(edge for edge in shape if edge) > MAX_BYTES:
        raise InvalidFile(Problem(key, f"has shape {shape}", f"{MAX_BYTES:,} bytes at most, edges of 0 left out"))
    return shape, items["fortran_order"] == "True", dtype


def npy_pieces(array: npt.NDArray[Any]) -> tuple[bytes, memoryview]:
    """Return an array as .npy: its header and its little-endian bytes."""
    array = np.asarray(array, array.dtype.newbyteorder("<"), order="C")
    return npy_head(array.shape, array.dtype), array.reshape(-1).view(np.uint8).data


def npy_head(shape: tuple[int, ...], dtype: np.dtype[Any]) -> bytes:
    """Return the header of an array whose little-endian bytes follow in C order."""
    descr = np.lib.format.dtype_to_descr(dtype.newbyteorder("<"))
    head = io.BytesIO()
    np.lib.format.write_array_header_1_0(head, {"descr": descr, "fortran_order": False, "shape": shape})
    return head.getvalue()
