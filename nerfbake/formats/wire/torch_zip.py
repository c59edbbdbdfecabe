"""torch's file (torch.save since 1.6), without torch: what its pickle says, and arrays of its storages.

    <p>/data.pkl      the objects (torch_pickle.py)       <p>/byteorder       little or big, since 2.1
    <p>/data/<key>    each storage's numbers, stored      anything else       not looked at

<p> is the file's own name, or `archive`. Local headers say no sizes: the central directory does. A writer may have
switched CRCs off, so that a storage with another one is read, and a note says so. Nothing of a storage is looked at
before an array of it is asked for.
"""

from __future__ import annotations

import zipfile
from typing import Any

import numpy as np
import numpy.typing as npt

from nerfbake import memory
from nerfbake.errors import InvalidFile, Problem
from nerfbake.formats.wire.npz_names import npz_keys
from nerfbake.formats.wire.torch_pickle import read_pickle
from nerfbake.formats.wire.torch_values import Array, Tensor
from nerfbake.formats.wire.zip_reader import ZipReader

MAX_PICKLE = 16 << 20  # bytes: real ones have some thousands
_WHAT = "a file as torch.save (1.6 or newer) writes it"
_LEGACY = bytes.fromhex("80028a0a6cfc9c46f920")  # how torch < 1.6 began
_PICKLE = "/data.pkl"


def is_torch(view: memoryview) -> bool:
    """True for an archive with the pickle of torch's."""
    return any(name.endswith(_PICKLE) for name in npz_keys(view))


class TorchReader:
    """What a file holds: root, and the arrays that are described in it. notes: what was found and does no harm."""

    def __init__(self, view: memoryview) -> None:
        if bytes(view[: len(_LEGACY)]) == _LEGACY:
            raise InvalidFile(f"is of torch before 1.6; allowed: {_WHAT}, so load it with torch and save it again")
        self._zip = ZipReader(view, _WHAT)
        self.notes: list[str] = []
        pickles = [name for name in self._zip.members if name.endswith(_PICKLE)]
        if len(pickles) != 1:
            raise InvalidFile(Problem("zip directory", f"lists {len(pickles)} members data.pkl", f"one, of {_WHAT}"))
        self._prefix = pickles[0].removesuffix(_PICKLE)
        self._big = self._small("byteorder") == b"big"
        size = self._zip.members[pickles[0]].file_size
        if size > MAX_PICKLE:
            raise InvalidFile(Problem("data.pkl", f"has {size:,} bytes", f"{MAX_PICKLE:,} at most"))
        memory.hold("data.pkl", 4 * size)  # its text may be wider in memory
        self.root = read_pickle(bytes(self._zip.unpacked(pickles[0], "data.pkl")), "data.pkl")

    def array(self, value: Any, name: str) -> npt.NDArray[Any]:
        """The array that a tensor, an array or a number of the pickle is; a view of the file where it can be. name:
        what errors call it. Raises InvalidFile."""
        if isinstance(value, Tensor):
            return self._view_of(value, name)
        if isinstance(value, Array) and value.value is not None:
            return value.value.astype(value.value.dtype.newbyteorder("="), copy=False)
        if type(value) in (int, float, bool):
            if not abs(value) < 1 << 62:
                raise InvalidFile(Problem(name, "is too large, or not a number", "a number below 2^62"))
            return np.array(value)
        raise InvalidFile(Problem(name, "is no array", "a tensor, an array or a number"))

    def _view_of(self, tensor: Tensor, name: str) -> npt.NDArray[Any]:
        storage = tensor.storage
        wide = storage.dtype == "bf16"
        kind = np.dtype("u2" if wide else storage.dtype).newbyteorder(">" if self._big else "<")
        raw = self._storage(storage.key, name)
        if len(raw) != storage.numbers * kind.itemsize:
            found = f"has {len(raw):,} bytes"
            raise InvalidFile(
                Problem(f"data/{storage.key:.40}", found, f"{storage.numbers * kind.itemsize:,} for {name}")
            )
        count = 1
        for edge in tensor.size:
            count *= edge
        last = tensor.offset + sum((edge - 1) * step for edge, step in zip(tensor.size, tensor.stride, strict=True))
        if not 0 < count <= storage.numbers or last >= storage.numbers:
            found = f"of shape {tensor.size} reaches number {last:,}"
            raise InvalidFile(Problem(name, found, f"numbers of its storage, which has {storage.numbers:,}"))
        steps = tuple(step * kind.itemsize for step in tensor.stride)
        array: npt.NDArray[Any] = np.ndarray(tensor.size, kind, raw, tensor.offset * kind.itemsize, steps)
        if wide:
            memory.hold(name, 4 * count)
            return (array.astype(np.uint32) << 16).view(np.float32)
        if kind == np.bool_:
            memory.hold(name, count)
            whole: npt.NDArray[Any] = array.view(np.uint8) != 0  # any other byte than 0 and 1 would be undefined
            return whole
        if not kind.isnative:
            memory.hold(name, array.nbytes)
        return array.astype(kind.newbyteorder("="), copy=False)

    def _storage(self, key: str, name: str) -> memoryview:
        member = f"{self._prefix}/data/{key}"
        if member not in self._zip.members:
            raise InvalidFile(Problem(name, f"has its numbers in data/{key:.40}, which is not there", "a member of it"))
        if self._zip.members[member].compress_type != zipfile.ZIP_STORED:
            raise InvalidFile(Problem(f"data/{key:.40}", "is compressed", "stored, as torch writes it"))
        raw = self._zip.unpacked(member, f"data/{key:.40}", damaged=True)
        note = f"{name} has another CRC-32 than the file says: it is damaged, or was written without"
        if note not in self.notes and not self._zip.is_whole(member, raw):
            self.notes.append(note)
        return raw

    def _small(self, name: str) -> bytes:
        member = f"{self._prefix}/{name}"
        if member not in self._zip.members or self._zip.members[member].file_size > 64:
            return b""
        return bytes(self._zip.unpacked(member, name)).strip()
