"""Size, modification time and SHA-256 of files and folders."""

from __future__ import annotations

import hashlib
import io
import os
import re
import struct
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

_PART = re.compile(r"\..+\.[0-9a-f]{16}\.(part|old)")  # unfinished outputs, see io.targets


class Stamp(NamedTuple):
    """File-system facts about a file, or about all files of a folder together; no file is read.

    bytes  total size
    mtime  latest modification time, of folders too, in nanoseconds
    files  number of files; None for a single file
    """

    bytes: int
    mtime: int
    files: int | None


Wanted = Callable[[Path], bool]


def stamp_of(path: str | Path, wanted: Wanted = lambda file: True) -> Stamp | None:
    """The stamp of a file, or of the wanted files in a folder and its subfolders; None if the path does not exist."""
    try:
        status = Path(path).stat()
        if not Path(path).is_dir():
            return Stamp(status.st_size, status.st_mtime_ns, None)
        found = [file.stat() for file in _below(Path(path), wanted)]
        folders = [Path(folder).stat().st_mtime_ns for folder, _, _ in os.walk(path)]
    except (OSError, ValueError):
        return None
    times = [status.st_mtime_ns, *folders, *(each.st_mtime_ns for each in found)]
    return Stamp(sum(each.st_size for each in found), max(times), len(found))


def digest_of(path: str | Path, wanted: Wanted = lambda file: True) -> str | None:
    """The SHA-256 of a file's bytes, or of the names and bytes of a folder's wanted files.

    None if the path does not exist or cannot be read.
    """
    try:
        if Path(path).is_dir():
            whole = hashlib.sha256()
            for file in sorted(_below(Path(path), wanted)):
                whole.update(os.fsencode(file.relative_to(path)) + b"\0" + _digest(file).encode())
            return whole.hexdigest()
        return _digest(Path(path)) if Path(path).is_file() else None
    except (OSError, ValueError):
        return None


def _below(folder: Path, wanted: Wanted) -> Iterator[Path]:
    for place, _, names in os.walk(folder):
        for name in names:
            file = Path(place) / name
            if not _PART.fullmatch(name) and file.is_file() and wanted(file):
                yield file


def _digest(file: Path) -> str:
    with open(file, "rb", buffering=0) as opened:
        return hashlib.file_digest(opened, "sha256").hexdigest()


_MAX_DIRECTORY = 1 << 20  # bytes, the same limit as in the format readers


def decoded_bytes(path: str | Path) -> int:
    """Bytes of a file; for an .npz those of its arrays, for a folder those of its files; 0 if the path does not exist.

    This is an estimate. The sizes that a file declares are not verified, but its directory is limited to
    _MAX_DIRECTORY.
    """
    try:
        if Path(path).is_dir():
            return sum(entry.stat().st_size for entry in os.scandir(path) if entry.is_file())
        if Path(path).name.lower().endswith(".npz"):
            with _Bounded(path) as file, zipfile.ZipFile(file) as archive:
                return sum(info.file_size for info in archive.infolist())
        return Path(path).stat().st_size
    except zipfile.BadZipFile:
        return Path(path).stat().st_size
    except (OSError, ValueError, NotImplementedError, EOFError, IndexError, struct.error):  # what zipfile raises
        return 0


class _Bounded(io.FileIO):
    """A file that limits each read to _MAX_DIRECTORY, because zipfile reads an archive's directory at once."""

    def read(self, size: int | None = -1, /) -> bytes:
        if size is not None and size > _MAX_DIRECTORY:
            raise zipfile.BadZipFile
        return super().read(size) or b""
