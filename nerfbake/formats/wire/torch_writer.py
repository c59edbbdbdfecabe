"""Write files that torch.load() can read, without torch.

The writer uses the opcodes of torch 1.13 and the zip archive described in torch.py. Numbers, text, dicts, lists and
tuples are written as such. Arrays are written as tensors, each with its own storage. Pass globals, NumPy arrays and
other objects as opcodes, in a Raw. The same values give the same bytes.
"""

from __future__ import annotations

import io
import struct
import zipfile
from typing import Any, NamedTuple

import numpy as np

from nerfbake.formats.wire.torch_values import STORAGES

_NAMES = {dtype: name for name, dtype in STORAGES.items()}


class Raw(NamedTuple):
    """Opcodes that push one value."""

    code: bytes


class TensorView(NamedTuple):
    """A tensor that is a view of a storage. offset, size and stride are in numbers, not bytes.

    numel: the number of elements that the pickle declares; None: the number of values.
    """

    values: Any
    offset: int
    size: tuple[int, ...]
    stride: tuple[int, ...]
    numel: int | None = None


def text(value: str) -> bytes:
    data = value.encode()
    return b"X" + struct.pack("<I", len(data)) + data


def glob(module: str, name: str) -> bytes:
    return b"c" + module.encode() + b"\n" + name.encode() + b"\n"


def numpy_array(array: Any) -> Raw:
    """Return the opcodes of NumPy's pickle in protocol 2: _reconstruct, then the state with bytes as latin-1 text."""
    array = np.asarray(array)
    kind = glob("numpy", "dtype") + text(array.dtype.str[1:]) + b"\x89\x88\x87R"
    kind += b"(K\x03" + text("<") + b"NNNJ\xff\xff\xff\xffJ\xff\xff\xff\xffK\x00tb"
    shape = b"(" + b"".join(_number(edge) for edge in array.shape) + b"t"
    data = glob("_codecs", "encode") + text(array.tobytes().decode("latin-1")) + text("latin1") + b"\x86R"
    made = (
        glob("numpy.core.multiarray", "_reconstruct") + glob("numpy", "ndarray") + b"K\x00\x85" + text("b") + b"\x87R"
    )
    return Raw(made + b"(K\x01" + shape + kind + b"\x89" + data + b"tb")


def ordered(items: dict[str, Any]) -> dict[str, Any]:
    """Mark a dict to be written as an OrderedDict."""
    return _Ordered(items)


class _Ordered(dict[str, Any]):
    pass


def _number(value: int) -> bytes:
    if 0 <= value < 256:
        return b"K" + bytes([value])
    if -(1 << 31) <= value < 1 << 31:
        return b"J" + struct.pack("<i", value)
    data = value.to_bytes(value.bit_length() // 8 + 1, "little", signed=True)
    return b"\x8a" + bytes([len(data)]) + data


class Writer:
    """Convert values to opcodes, and collect their storages in the order of their keys.

    location: the device that the file names for its tensors. torch.load() fails if the reader has no such device.
    """

    def __init__(self, location: str = "cpu") -> None:
        self.storages: list[bytes] = []
        self._location = location

    def code(self, value: Any) -> bytes:
        if isinstance(value, Raw):
            return value.code
        if value is None or isinstance(value, bool):
            return {None: b"N", True: b"\x88", False: b"\x89"}[value]
        if isinstance(value, int):
            return _number(value)
        if isinstance(value, float):
            return b"G" + struct.pack(">d", value)
        if isinstance(value, str):
            return text(value)
        if isinstance(value, tuple) and not isinstance(value, TensorView):
            return b"(" + b"".join(map(self.code, value)) + b"t"
        if isinstance(value, list):
            return b"](" + b"".join(map(self.code, value)) + b"e"
        if isinstance(value, dict):
            begin = glob("collections", "OrderedDict") + b")R" if isinstance(value, _Ordered) else b"}"
            return begin + b"(" + b"".join(self.code(part) for item in value.items() for part in item) + b"u"
        return self._tensor(value if isinstance(value, TensorView) else _whole(np.asarray(value)))

    def _tensor(self, view: TensorView) -> bytes:
        values = np.asarray(view.values)
        kind = glob("torch", _NAMES[values.dtype.str[1:]])
        key = text(str(len(self.storages)))
        self.storages.append(values.tobytes())
        numel = values.size if view.numel is None else view.numel
        storage = b"(" + text("storage") + kind + key + text(self._location) + _number(numel) + b"tQ"
        rest = self.code(view.offset) + self.code(view.size) + self.code(view.stride)
        hooks = glob("collections", "OrderedDict") + b")R"
        return glob("torch._utils", "_rebuild_tensor_v2") + b"(" + storage + rest + b"\x89" + hooks + b"tR"


def _whole(array: Any) -> TensorView:
    stride = tuple(step // array.itemsize for step in np.zeros(array.shape, array.dtype).strides)
    return TensorView(array.reshape(-1), 0, array.shape, stride)


def archive(
    pickle: bytes, storages: list[bytes], *, prefix: str = "archive", more: dict[str, bytes] | None = None
) -> bytes:
    """Return a zip archive with all members stored, as torch writes it."""
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_STORED) as made:
        members = {"data.pkl": pickle} | {f"data/{key}": data for key, data in enumerate(storages)}
        for name, data in (members | {"version": b"3\n"} | (more or {})).items():
            made.writestr(zipfile.ZipInfo(f"{prefix}/{name}"), data)
    return file.getvalue()


def torch_file(value: Any, *, location: str = "cpu", **options: Any) -> bytes:
    """Return a file from which torch.load() restores this value; options: those of archive()."""
    writer = Writer(location)
    pickle = b"\x80\x02" + writer.code(value) + b"."
    return archive(pickle, writer.storages, **options)
