"""A file that says which process writes to a folder that several machines may share.

The process number and the host stand in the file for people and for other machines. On one machine the kernel decides:
the process holds a lock (flock) on the file for as long as it lives, however it ends and whatever process has its
number afterwards.
"""

from __future__ import annotations

import json
import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from nerfbake.errors import OutputError
from nerfbake.io.own_files import open_own
from nerfbake.io.sources import blame

try:
    import fcntl
except ImportError:  # no such locks on this system: then a file that is left behind has to be taken over
    fcntl = None  # type: ignore[assignment]

_LONGEST = 4096  # bytes


@contextmanager
def occupied(path: str | Path, *, take_over: bool = False) -> Iterator[None]:
    """For as long as the block lasts, a file with our process number and host stands there.

    Raises OutputError where another process is at work, or where one on another host may be; take_over: replaces its
    file. The file of a process on this host that has ended is replaced in any case.
    """
    with blame(str(path), OutputError):
        Path(path).parent.mkdir(parents=True, exist_ok=True)
        handle = _acquire(Path(path), take_over)
    try:
        yield
    finally:
        with suppress(OSError):
            if _is_at(path, handle):  # else another process has taken it over
                Path(path).unlink()
        os.close(handle)


def _acquire(path: Path, take_over: bool) -> int:
    """The open file with our words, locked. Raises OutputError, OSError."""
    while True:
        try:
            handle, new = open_own(path, os.O_RDWR | os.O_CREAT | os.O_EXCL), True
        except FileExistsError:
            handle, new = open_own(path, os.O_RDWR | os.O_CREAT), False
        try:
            free = _lock(handle)
            if not _is_at(path, handle):
                os.close(handle)  # it was removed between the two: once more
                continue
            owner = os.pread(handle, _LONGEST, 0)
            if not (take_over or (free and _may_be_replaced(owner)) or (new and free is None)):
                raise OutputError(_told(owner))
            if free is False:  # it is taken over from a process that may live, and keeps its own file
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


def _lock(handle: int) -> bool | None:
    """Locks an open file. False: another process has it; None: this file system has no locks."""
    if fcntl is None:
        return None
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:
        return None
    return True


def _may_be_replaced(owner: bytes) -> bool:
    """Of a file that no process has locked: True if it was written on this host, or not yet written at all."""
    found = _parsed(owner)
    return not owner or (found is not None and found[1] == socket.gethostname())


def _told(owner: bytes) -> str:
    """What is wrong: which process is at work, or may be."""
    found = _parsed(owner)
    if found is None:
        return "another process is at work; allowed: to wait for it, or `take_over`"
    return f"process {found[0]} on {found[1]} is at work; allowed: to wait for it, or `take_over`"


def _parsed(owner: bytes) -> tuple[int, str] | None:
    try:
        found = json.loads(owner)
        return int(found["pid"]), str(found["host"])
    except (ValueError, TypeError, KeyError, OverflowError, RecursionError):
        return None


def _is_at(path: str | Path, handle: int) -> bool:
    """True if this open file stands at the path."""
    with suppress(FileNotFoundError):
        return os.path.samestat(os.lstat(path), os.fstat(handle))
    return False
