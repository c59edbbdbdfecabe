"""A lock file that names the process that writes to a folder, which several machines may share.

The file contains the process ID and the host, for people and for other machines. On one machine the kernel decides: the
process holds a lock (flock) on the file as long as it runs. The lock ends with the process, whatever ends it, and even
if its process ID is reused.
"""

from __future__ import annotations

import json
import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from nerfbake.errors import OutputError
from nerfbake.io.own_files import lock, open_own
from nerfbake.io.sources import blame

_LONGEST = 4096  # bytes


@contextmanager
def occupied(path: str | Path, *, take_over: bool = False) -> Iterator[None]:
    """Keep a lock file with this process's ID and host at the path for the duration of the block.

    Raises OutputError if another process holds the lock, or if a process on another host may hold it. take_over:
    replace the lock file even then. The lock file of a process on this host that has ended is always replaced.
    """
    with blame(str(path), OutputError):
        Path(path).parent.mkdir(parents=True, exist_ok=True)
        handle = _acquire(Path(path), take_over)
    try:
        yield
    finally:
        with suppress(OSError):
            if _is_at(path, handle):  # otherwise another process has taken it over
                Path(path).unlink()
        os.close(handle)


def _acquire(path: Path, take_over: bool) -> int:
    """Return the open lock file, locked and with our contents. Raises OutputError, OSError."""
    while True:
        try:
            handle, new = open_own(path, os.O_RDWR | os.O_CREAT | os.O_EXCL), True
        except FileExistsError:
            handle, new = open_own(path, os.O_RDWR | os.O_CREAT), False
        try:
            free = lock(handle)  # None: a lock file that was left behind must be taken over
            if not _is_at(path, handle):
                os.close(handle)  # it was removed between open and lock: try again
                continue
            owner = os.pread(handle, _LONGEST, 0)
            if not (take_over or (free and _may_be_replaced(owner)) or (new and free is None)):
                raise OutputError(_owner_text(owner))
            if free is False:  # taken over from a process that may still run: it keeps its own file
                path.unlink()
                os.close(handle)
                continue
            os.ftruncate(handle, 0)
            os.pwrite(handle, json.dumps({"pid": os.getpid(), "host": socket.gethostname()}).encode(), 0)
            return handle
        except BaseException:
            with suppress(OSError):
                os.close(handle)
            raise


def _may_be_replaced(owner: bytes) -> bool:
    """For a file that no process has locked: True if it is empty or was written on this host."""
    found = _parsed(owner)
    return not owner or (found is not None and found[1] == socket.gethostname())


def _owner_text(owner: bytes) -> str:
    """The error message: which process holds the lock, or may hold it."""
    found = _parsed(owner)
    if found is None:
        return "is in use by another process; allowed: to wait for it, or `take_over`"
    return f"is in use by process {found[0]} on {found[1]}; allowed: to wait for it, or `take_over`"


def _parsed(owner: bytes) -> tuple[int, str] | None:
    try:
        found = json.loads(owner)
        return int(found["pid"]), str(found["host"])
    except (ValueError, TypeError, KeyError, OverflowError, RecursionError):
        return None


def _is_at(path: str | Path, handle: int) -> bool:
    """True if the path refers to this open file."""
    with suppress(FileNotFoundError):
        return os.path.samestat(os.lstat(path), os.fstat(handle))
    return False
