"""A file that says who is at work, where locks of the system do not reach: on disks that machines share."""

from __future__ import annotations

import json
import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from nerfbake.errors import OutputError
from nerfbake.io.sources import blame


@contextmanager
def occupied(path: str | Path, *, take_over: bool = False) -> Iterator[None]:
    """For as long as the block lasts, a file with our process number and host stands there.

    Raises OutputError where there is one already, which says whose it is; take_over: replaces it.
    """
    ours = json.dumps({"pid": os.getpid(), "host": socket.gethostname()}).encode()
    with blame(str(path), OutputError):
        Path(path).parent.mkdir(parents=True, exist_ok=True)
        if take_over:
            Path(path).unlink(missing_ok=True)
        try:
            with open(path, "xb") as file:
                file.write(ours)
        except FileExistsError:
            raise OutputError(_owner(Path(path)), source=str(path)) from None
    try:
        yield
    finally:
        with suppress(OSError):
            if Path(path).read_bytes() == ours:  # else somebody has taken it over
                Path(path).unlink()


def _owner(path: Path) -> str:
    """What is wrong: who is at work, or has been."""
    try:
        owner = json.loads(path.read_bytes()[:4096])
        pid, host = int(owner["pid"]), str(owner["host"])
    except (OSError, ValueError, TypeError, KeyError):
        return "somebody is at work; allowed: to wait, or --take-over"
    if host == socket.gethostname() and not _lives(pid):
        return f"was left behind by process {pid} on {host}, which is gone; allowed: --take-over"
    return f"process {pid} on {host} is at work; allowed: to wait for it, or --take-over"


def _lives(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except (OSError, OverflowError):
        return True
    return True
