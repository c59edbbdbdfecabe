"""What other processes print, kept in files whose end is what counts."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

from nerfbake.errors import OutputError
from nerfbake.io.own_files import open_own, require_no_link
from nerfbake.io.sources import blame

KEPT = 64 << 10  # bytes of the end


@contextmanager
def opened_log(path: Path) -> Iterator[IO[bytes]]:
    """A new file for a process to print into. Raises OutputError."""
    with blame(str(path), OutputError):
        require_no_link(path.parent)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.unlink(missing_ok=True)  # of a link, what it leads to stays as it is
        with open(path, "wb", buffering=0, opener=open_own) as file:
            yield file


def end_of_log(path: Path) -> str:
    """The last bytes as text; the file is cut down to them. '' where it cannot be read."""
    try:
        with open(path, "r+b", buffering=0, opener=open_own) as file:
            size = file.seek(0, os.SEEK_END)
            file.seek(max(0, size - KEPT))
            end = file.read(KEPT)
            if size > KEPT:
                file.seek(0)
                file.write(end)
                file.truncate()
    except (OSError, OutputError):
        return ""
    return end.decode(errors="replace")
