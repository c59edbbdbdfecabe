"""Read files, folders and stdin whole, and name them in errors."""

from __future__ import annotations

import mmap
import os
import stat
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path, PurePosixPath
from typing import IO

from nerfbake import memory
from nerfbake.catalog import require_content
from nerfbake.contract import composed_name
from nerfbake.errors import InvalidFile, NerfbakeError

STREAM = "-"
_CHUNK = 1 << 20
_HUGE = 1 << 21  # bytes of a large page: one page fault instead of 512


def reading_name(source: str | Path) -> str:
    """The name of a source in messages and errors."""
    return "stdin" if str(source) == STREAM else str(source)


@contextmanager
def blame(name: str, error_type: type[NerfbakeError] = InvalidFile) -> Iterator[None]:
    """Add the file's name to every error that leaves the block, and convert OSError into `error_type`."""
    try:
        yield
    except NerfbakeError as error:
        if error.source is None:
            error.source = name
        raise
    except OSError as error:
        broken = broken_link(name) if isinstance(error, FileNotFoundError) else ""
        allowed = "; allowed: an existing file or folder"
        raise error_type(f"{broken}{allowed}" if broken else f"{error.strerror or error}", source=name) from error


def broken_link(path: str | Path) -> str:
    """Return the description of a path that is a link to nothing, or is behind one; '' for any other path."""
    with suppress(OSError, ValueError):
        for place in (Path(path), *Path(path).parents):
            if place.is_symlink() and not place.exists():
                link = f"a broken link to {place.readlink()}"
                return f"is {link}" if place == Path(path) else f"is behind {place}, {link}"
    return ""


def read_file(path: Path) -> memoryview:
    """Return all bytes of a file, pipe or device. Raises InvalidFile, MemoryLimit, OSError.

    The file is read, not mapped: if a mapped file is truncated, the process that reads the mapping is killed (SIGBUS).
    """
    with open(path, "rb", buffering=0) as file:
        status = os.fstat(file.fileno())
        if not stat.S_ISREG(status.st_mode) or not status.st_size:
            return read_stream(file)  # size 0: an empty file, or a file in /proc, which does not report its size
        memory.hold("the file", status.st_size)
        buffer = _room(status.st_size)
        at = 0
        while at < len(buffer):
            count = file.readinto(buffer[at:])
            if not count:
                raise InvalidFile(
                    f"was truncated to {at:,} bytes while it was read; allowed: a file that does not change"
                )
            at += count
        require_content(bytes(buffer[:64]))
        return buffer.toreadonly()


def require_some(view: memoryview) -> None:
    """Raise InvalidFile if there are no bytes."""
    if not len(view):
        raise InvalidFile("is empty; allowed: a file that nerfbake reads")


def read_stdin() -> memoryview:
    """Return all bytes of stdin. Raises InvalidFile if stdin is closed, MemoryLimit."""
    if sys.stdin is None:
        raise InvalidFile("is closed; allowed: a pipe or a file")
    return read_stream(sys.stdin.buffer)


def read_stream(file: IO[bytes]) -> memoryview:
    """Return all bytes of a stream of unknown size."""
    data = bytearray()
    while chunk := file.read(_CHUNK):
        memory.hold("the stream", len(chunk))
        data += chunk
    require_content(bytes(data[:64]))
    return memoryview(data).toreadonly()


def _room(size: int) -> memoryview:
    """Allocate a buffer, with large pages of memory if the system has them."""
    if size < _HUGE or not hasattr(mmap, "MADV_HUGEPAGE"):
        return memoryview(bytearray(size))
    room = mmap.mmap(-1, size, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)  # shared memory has small pages only
    room.madvise(mmap.MADV_HUGEPAGE)
    return memoryview(room)


class StoredNames:
    """The names of files in a folder and below, where composed and decomposed names are equal."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._known: dict[Path, dict[str, str]] = {}  # by folder, because a capture may lack 100,000 pictures

    def path(self, name: str) -> Path:
        """Return the path of a name, each part as it is stored if it is not stored as given. It need not exist."""
        path = self._folder / name
        if name.isascii() or os.path.lexists(path):
            return path
        path = self._folder
        for part in PurePosixPath(name).parts:
            path /= part if os.path.lexists(path / part) else self._stored(path).get(composed_name(part), part)
        return path

    def _stored(self, folder: Path) -> dict[str, str]:
        """Return the names in a folder by their composed form; empty if it cannot be read."""
        if folder not in self._known:
            names: list[str] = []
            with suppress(OSError):
                names = sorted((entry.name for entry in os.scandir(folder)), reverse=True)
            self._known[folder] = {composed_name(name): name for name in names}
        return self._known[folder]


class Folder(Mapping[str, memoryview]):
    """The files of a folder by name. Each file is read once, at its first access.

    `more` files count as files of the folder and take precedence. broken: the first symbolic link without a target that
    was in place of a file that was asked for; None if there was none.
    """

    def __init__(self, path: Path, more: Mapping[str, memoryview]) -> None:
        self._path, self._more, self._stored = path, dict(more), StoredNames(path)
        self.broken: Path | None = None

    def __getitem__(self, name: str) -> memoryview:
        if name not in self._more:
            path = self._path / name
            if not path.is_file():
                raise KeyError(name)
            with blame(str(path)), memory.scope():
                self._more[name] = read_file(path)
            memory.grown(self, name, len(self._more[name]))  # beyond the scope in which the file is needed first
        return self._more[name]

    def __contains__(self, name: object) -> bool:
        if name in self._more or not isinstance(name, str):
            return name in self._more
        path = self._path
        for part in PurePosixPath(name).parts:  # ends early: a COLMAP model is looked for in 300 places
            if not os.path.lexists(path / part):
                break
            path /= part
        else:
            if path.is_file():
                return True
        if path is not self._path and self.broken is None and path.is_symlink() and not path.exists():
            self.broken = path
        return False

    def holds(self, name: str) -> bool:
        """Whether a file is below this folder with all links followed, so that no name in a file leads out of it."""
        return name in self and (self._path / name).resolve().is_relative_to(self._path.resolve())

    def names(self, folder: str) -> list[str]:
        """The names of the files in a subfolder ('' for this folder), sorted; empty if there is no such folder."""
        path = self._stored.path(folder)
        with blame(str(path)):
            return sorted(entry.name for entry in os.scandir(path) if entry.is_file()) if path.is_dir() else []

    @property
    def bytes_read(self) -> int:
        """The bytes of all files that were read so far."""
        return sum(map(len, self._more.values()))

    def head(self, name: str, size: int) -> bytes:
        """The first `size` bytes of a file, or all of a shorter one; empty if there is no such file."""
        if name in self._more:
            return bytes(self._more[name][:size])
        path = self._stored.path(name)
        with suppress(OSError):
            if path.is_file():
                with open(path, "rb") as file:
                    return file.read(size)
        return b""

    def __iter__(self) -> Iterator[str]:
        return iter(sorted({path.name for path in self._path.iterdir()} | set(self._more)))

    def __len__(self) -> int:
        return sum(1 for _ in self)
