"""What files and folders hold, as a size, a time and a SHA-256."""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

_PART = re.compile(r"\..+\.[0-9a-f]{16}\.(part|old)")  # what a writer has not finished: io.targets


class Stamp(NamedTuple):
    """What the system says of a file, or of all files of a folder together, without reading them.

    bytes  of all
    mtime  the latest, of folders, too: nanoseconds
    files  how many; None: it is a file itself
    """

    bytes: int
    mtime: int
    files: int | None


Wanted = Callable[[Path], bool]


def stamp_of(path: str | Path, wanted: Wanted = lambda file: True) -> Stamp | None:
    """The stamp of a file, or of the wanted files of a folder and what is below it; None where there is neither."""
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
    """The SHA-256 of a file's bytes, or of the names and bytes of a folder's wanted files; None where there is neither,
    or it cannot be read.
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
