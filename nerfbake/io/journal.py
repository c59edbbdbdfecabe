"""A journal: an append-only file of JSON lines. Each line is on disk before the next one is written.

One process appends to a file, from any number of threads. A crash can leave an incomplete line: readers skip it, and
the next writer terminates it first.
"""

from __future__ import annotations

import json
import os
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any

from nerfbake.errors import OutputError
from nerfbake.io.own_files import open_own
from nerfbake.io.sources import blame

Event = dict[str, Any]
_LONGEST = 16 << 20  # maximum bytes of a line: a command line has at most 2 MiB


class Journal:
    """The file that this process appends to. Its folder is created if necessary. Raises OutputError."""

    def __init__(self, path: str | Path) -> None:
        self._name, self._lock = str(path), threading.Lock()
        with blame(self._name, OutputError):
            Path(path).parent.mkdir(parents=True, exist_ok=True)
            self._file = open(path, "a+b", buffering=0, opener=open_own)  # noqa: SIM115
            if self._file.seek(0, os.SEEK_END) and not self._ends_a_line():
                self._file.write(b"\n")

    def _ends_a_line(self) -> bool:
        self._file.seek(-1, os.SEEK_END)
        return self._file.read(1) == b"\n"

    def write(self, event: Event) -> None:
        """Append a line, which is on disk when this returns. Raises OutputError."""
        line = json.dumps(event, separators=(",", ":")).encode() + b"\n"
        with self._lock, blame(self._name, OutputError):
            if self._file.write(line) != len(line):
                raise OutputError("cannot be extended; allowed: a disk with free space", source=self._name)
            os.fsync(self._file.fileno())

    def close(self) -> None:
        self._file.close()


def read_journal(path: str | Path) -> Iterator[Event]:
    """Yield the lines of a file, without incomplete ones; nothing if the file does not exist."""
    with blame(str(path)):
        if not os.path.lexists(path):
            return
        with open(path, "rb", opener=open_own) as file:
            for line in _lines(file):
                try:
                    event = json.loads(line)
                except (ValueError, RecursionError):
                    continue
                if isinstance(event, dict):
                    yield event


def _lines(file: IO[bytes]) -> Iterator[bytes]:
    """Yield lines, without those that are too long for a journal."""
    whole = True
    while line := file.readline(_LONGEST):
        ends = line.endswith(b"\n")
        if whole and (ends or len(line) < _LONGEST):
            yield line
        whole = ends


def journals(folder: str | Path, pattern: str) -> list[Path]:
    """The files of a folder that match a pattern, sorted by name."""
    return sorted(Path(folder).glob(pattern))
