"""What happened, line by line, in a file that outlives whoever writes it: JSON lines, each on the disk before the next.

One process appends to a file, in as many threads as it likes. A line that a crash has torn is no line: whoever reads
passes over it, and whoever appends next ends it first.
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
_LONGEST = 16 << 20  # bytes of a line: a command line has at most 2 MiB


class Journal:
    """The file that this process appends to; a folder that leads there is made. Raises OutputError."""

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
        """A line more, which is on the disk when this returns. Raises OutputError."""
        line = json.dumps(event, separators=(",", ":")).encode() + b"\n"
        with self._lock, blame(self._name, OutputError):
            if self._file.write(line) != len(line):
                raise OutputError("takes no more; allowed: a disk with room", source=self._name)
            os.fsync(self._file.fileno())

    def close(self) -> None:
        self._file.close()


def read_journal(path: str | Path) -> Iterator[Event]:
    """The lines of a file, one at a time, but for those that are torn; none where there is no file."""
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
    """Lines, without those that are too long to be ours."""
    whole = True
    while line := file.readline(_LONGEST):
        ends = line.endswith(b"\n")
        if whole and (ends or len(line) < _LONGEST):
            yield line
        whole = ends


def journals(folder: str | Path, pattern: str) -> list[Path]:
    """Files of a folder whose names are like this, in the order of these."""
    return sorted(Path(folder).glob(pattern))
