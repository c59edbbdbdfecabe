"""Open and lock files in folders where anybody may create files, and keep logs of other processes.

Symbolic links are never followed.
"""

from __future__ import annotations

import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO

from nerfbake.errors import OutputError
from nerfbake.io.sources import blame

try:
    import fcntl
except ImportError:  # this system has no flock
    fcntl = None  # type: ignore[assignment]


def require_no_link(path: str | Path) -> None:
    """Raise OutputError if the path is a symbolic link."""
    if Path(path).is_symlink():
        raise OutputError("is a symbolic link; allowed: a regular file or folder", source=str(path))


def open_own(path: str | Path, flags: int) -> int:
    """Open a regular file like os.open(), as an opener for open(). Links, pipes and devices are rejected.

    Raises OutputError, OSError.
    """
    require_no_link(path)  # O_NOFOLLOW also rejects it, but its message does not mention a link
    more = getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_CLOEXEC", 0)
    handle = os.open(path, flags | more, 0o666)
    if not stat.S_ISREG(os.fstat(handle).st_mode):
        os.close(handle)
        raise OutputError("is not a regular file; allowed: a regular file", source=str(path))
    return handle


def lock(handle: int) -> bool | None:
    """Lock an open file or folder until it is closed.

    False: another process holds the lock; None: this system or file system has no locks.
    """
    if fcntl is None:
        return None
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:
        return None
    return True


KEPT = 64 << 10  # bytes at the end of a log that are kept


@contextmanager
def opened_log(path: Path) -> Iterator[IO[bytes]]:
    """Open a new file for the output of a process. Raises OutputError."""
    with blame(str(path), OutputError):
        require_no_link(path.parent)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.unlink(missing_ok=True)  # a link is removed, not its target
        with open(path, "wb", buffering=0, opener=open_own) as file:
            yield file


def trim_log(path: Path) -> None:
    """Cut a log down to its last 64 KiB, if it can be opened."""
    with suppress(OSError, OutputError), open(path, "r+b", buffering=0, opener=open_own) as file:
        size = file.seek(0, os.SEEK_END)
        if size > KEPT:
            file.seek(size - KEPT)
            end = file.read(KEPT)
            file.seek(0)
            file.write(end)
            file.truncate()
