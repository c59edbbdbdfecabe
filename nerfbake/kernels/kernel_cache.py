"""The cache of compiled kernels: what cannot be read is compiled anew, and what cannot be written stays in memory.

Numba unpickles whatever its files contain, and fails if a disk is full. Here each file begins with the hash of the
rest, so that nothing damaged is unpickled, and the index has the hash of each data file: two processes may have
written one of the same name.
"""

from __future__ import annotations

import hashlib
import pickle
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import numba
from numba.core.caching import IndexDataCacheFile

_HASH = 32  # bytes


def harden_cache(cache: Any, report: Callable[[], None]) -> None:
    """Make numba's cache of a function ignore damaged files and full disks. report is called if one cannot be written.

    A damaged file, or one of an older version that refers to types that no longer exist, is replaced.
    """
    file, save, load = cache._cache_file, cache.save_overload, cache.load_overload
    cache._cache_file = KernelCacheFile(file._cache_path, file._index_name[: -len(".nbi")], file._source_stamp)

    def save_overload(signature: Any, data: Any) -> None:
        try:
            save(signature, data)
        except OSError:
            report()

    def load_overload(signature: Any, context: Any) -> Any:
        with suppress(Exception):  # whatever is wrong with it, it can be compiled anew
            return load(signature, context)
        return None

    cache.save_overload, cache.load_overload = save_overload, load_overload


class KernelCacheFile(IndexDataCacheFile):
    """The index of a kernel, and a data file for each of its signatures."""

    __init__: Any  # numba has no types
    _dump: Any
    _data_path: Any
    _data_name: Any

    def save(self, key: Any, data: Any) -> None:
        """Write the data, then the index. Raises OSError."""
        kernels = self._load_index()
        content = self._dump(data)
        taken = {name for name, _ in kernels.values()}
        name, _ = kernels.get(key) or (next(name for name in self._names() if name not in taken), b"")
        kernels[key] = name, self._write(self._data_path(name), content)
        self._save_index(kernels)

    def load(self, key: Any) -> Any:
        """Return the data, or None if there is none. Raises OSError, and what unpickling raises."""
        name, hashed = self._load_index().get(key) or ("", b"")
        content = self._read(self._data_path(name), hashed) if name else None
        return None if content is None else pickle.loads(content)

    def _names(self) -> Any:
        return (self._data_name(number) for number in range(1, 1 << 30))

    def _load_index(self) -> dict[Any, tuple[str, bytes]]:
        with suppress(Exception):
            version, rest = pickle.loads(self._read(self._index_path) or b"")
            if version == (numba.__version__, self._source_stamp):
                kernels: dict[Any, tuple[str, bytes]] = pickle.loads(rest)
                return kernels
        return {}

    def _save_index(self, kernels: dict[Any, tuple[str, bytes]]) -> None:
        version = numba.__version__, self._source_stamp
        self._write(self._index_path, pickle.dumps((version, self._dump(kernels))))

    def _read(self, path: str, hashed: bytes | None = None) -> bytes | None:
        """Return the content of a file, or None if it is damaged or has another hash."""
        with open(path, "rb") as file:
            own, content = file.read(_HASH), file.read()
        return content if own == _hash(content) and hashed in (None, own) else None

    def _write(self, path: str, content: bytes) -> bytes:
        """Write a file and return the hash of its content."""
        hashed = _hash(content)
        with self._open_for_write(path) as file:
            file.write(hashed + content)
        return hashed


def _hash(content: bytes) -> bytes:
    return hashlib.sha256(content).digest()
