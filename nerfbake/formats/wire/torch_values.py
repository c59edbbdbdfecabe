"""The values that the pickle of a torch file may create: descriptions of tensors and arrays, dicts, and bytes.

Each builder checks all arguments in the file. Its result is no larger than the arguments, so that a small file cannot
use much memory.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, NoReturn

import numpy as np
import numpy.typing as npt

MAX_DIMENSIONS = 8
_MOST = 1 << 48  # numbers of a storage

# The NumPy dtypes of torch's storages. NumPy has no bfloat16: its bits are read as integers.
STORAGES = {
    "DoubleStorage": "f8",
    "FloatStorage": "f4",
    "HalfStorage": "f2",
    "BFloat16Storage": "bf16",
    "LongStorage": "i8",
    "IntStorage": "i4",
    "ShortStorage": "i2",
    "CharStorage": "i1",
    "ByteStorage": "u1",
    "BoolStorage": "b1",
}
_NUMBERS = ("f2", "f4", "f8", "i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8", "b1")


class Storage(NamedTuple):
    """The storage of tensors: a number of values of a dtype of STORAGES, in the member data/<key>."""

    dtype: str
    key: str
    numbers: int


class Tensor(NamedTuple):
    """A view of a storage; offset and stride are in numbers, not bytes."""

    storage: Storage
    offset: int
    size: tuple[int, ...]
    stride: tuple[int, ...]


class Array:
    """A NumPy array or number; its value is None until its state is set."""

    def __init__(self, value: npt.NDArray[Any] | None = None) -> None:
        self.value = value


class Dtype:
    """A NumPy dtype; its state sets the byte order."""

    def __init__(self, code: str) -> None:
        self.code, self.order = code, "<"

    @property
    def dtype(self) -> np.dtype[Any]:
        return np.dtype(self.code if self.code.endswith("1") else self.order + self.code)


class Config(dict[Any, Any]):
    """An OrderedDict, or a config dict of mmcv. Its state is ignored: it repeats the items or is irrelevant."""


class Global(NamedTuple):
    """A module and a name in it, which are never looked up."""

    name: str


class Fault(Exception):
    """An invalid opcode: what was found, and what is allowed."""

    def __init__(self, found: str, allowed: str) -> None:
        self.found, self.allowed = found, allowed


def fill(target: dict[Any, Any], pairs: list[Any]) -> None:
    """Set items of a dict; their keys must be text or integers."""
    for pair in pairs:
        if not isinstance(pair, list | tuple) or len(pair) != 2 or type(pair[0]) not in (str, int):
            raise Fault("has items that are not pairs", "pairs of a key (text or a whole number) and a value")
        target[pair[0]] = pair[1]


# -- builders --------------------------------------------------------------------------------------------------
def _wrong(what: str) -> NoReturn:
    raise Fault(f"has unexpected arguments for {what}", "the arguments that torch and NumPy write")


def _dict(arguments: tuple[Any, ...]) -> Config:
    """Build a dict from no arguments, a list of pairs, pairs, or a dict, as mmengine writes it."""
    made = Config()
    match arguments:
        case (dict() as items,):
            made.update(items)
        case (list() as pairs,):
            fill(made, pairs)
        case _:
            fill(made, list(arguments))
    return made


def _tensor(arguments: tuple[Any, ...]) -> Tensor:
    """Build a tensor from (storage, offset, size, stride, ...); further arguments are ignored."""
    match arguments:
        case (Storage() as storage, int(offset), tuple() as size, tuple() as stride, *_) if len(size) <= MAX_DIMENSIONS:
            numbers = [offset, *size, *stride[:MAX_DIMENSIONS]]
            if len(size) == len(stride) and all(type(n) is int and 0 <= n < _MOST for n in numbers):
                return Tensor(storage, offset, size, stride)
    _wrong("a tensor")


def _parameter(arguments: tuple[Any, ...]) -> Tensor:
    if not arguments or not isinstance(arguments[0], Tensor):
        _wrong("a parameter")
    return arguments[0]


def _dtype(arguments: tuple[Any, ...]) -> Dtype:
    if not arguments or arguments[0] not in _NUMBERS:
        _wrong("a dtype")
    return Dtype(arguments[0])


def order_in(state: Any) -> str:
    """Return the byte order in a dtype's state."""
    match state:
        case (int(), ("<" | ">" | "|" | "=") as order, *_):
            return "<" if order in "|=" else str(order)
    _wrong("a dtype")


def _encoded(arguments: tuple[Any, ...]) -> bytes:
    """Build bytes, which protocol 2 stores as text."""
    match arguments:
        case (str(text), "latin1"):
            try:
                return text.encode("latin-1")
            except UnicodeEncodeError:
                pass
    _wrong("bytes")


def _scalar(arguments: tuple[Any, ...]) -> Array:
    match arguments:
        case (Dtype() as kind, bytes(data)) if len(data) == kind.dtype.itemsize:
            return Array(np.frombuffer(data, kind.dtype).reshape(()))
    _wrong("a number")


def filled(state: Any) -> npt.NDArray[Any]:
    """Build an array from its state: (version, shape, dtype, Fortran order, bytes)."""
    match state:
        case (int(), tuple() as shape, Dtype() as kind, bool(fortran), bytes(data)) if len(shape) <= MAX_DIMENSIONS:
            size = kind.dtype.itemsize
            for edge in shape:
                size *= edge if type(edge) is int and edge > 0 else 0
            if size == len(data) and size:
                return np.frombuffer(data, kind.dtype).reshape(shape, order="F" if fortran else "C")
    _wrong("an array")


BUILDERS: dict[str, Callable[[tuple[Any, ...]], Any]] = {
    "collections OrderedDict": _dict,
    "mmcv.utils.config ConfigDict": _dict,
    "mmengine.config.config ConfigDict": _dict,
    "addict.addict Dict": _dict,
    "torch._utils _rebuild_tensor": _tensor,
    "torch._utils _rebuild_tensor_v2": _tensor,
    "torch._utils _rebuild_parameter": _parameter,
    "_codecs encode": _encoded,
    "numpy dtype": _dtype,
    "numpy ndarray": lambda arguments: _wrong("a class"),
    **{f"numpy.{core}.multiarray _reconstruct": lambda arguments: Array() for core in ("core", "_core")},
    **{f"numpy.{core}.multiarray scalar": _scalar for core in ("core", "_core")},
}
