"""The result of a command, as JSON lines on a file descriptor that the process inherits from a batch.

Each line is an object. A later line replaces the keys that it shares with an earlier one, so a process that is killed
leaves what it has reported until then. The keys: `error`, the line that the command failed with, and `psnr` in dB, of
what the command wrote.
"""

from __future__ import annotations

import json
import os
from contextlib import suppress
from typing import Any

VARIABLE = "NERFBAKE_RESULT"  # names the descriptor
_MOST = 64 << 10  # bytes: the capacity of a pipe on Linux

_descriptor: int | None = None


def claim_descriptor() -> None:
    """Take the descriptor that the environment names, so that processes started from here do not inherit it."""
    global _descriptor
    number = os.environ.pop(VARIABLE, "")
    with suppress(OSError, ValueError):
        os.set_inheritable(int(number), False)
        os.set_blocking(int(number), False)
        _descriptor = int(number)


def report_result(**facts: Any) -> None:
    """Report facts to the batch that started this process; do nothing if no batch did."""
    if _descriptor is not None:
        with suppress(OSError):  # the batch is gone, or its pipe is full
            os.write(_descriptor, json.dumps(facts).encode() + b"\n")


def read_result(descriptor: int) -> dict[str, Any]:
    """The facts that a process has written to the other end of this pipe, which must not block."""
    facts: dict[str, Any] = {}
    try:
        lines = os.read(descriptor, _MOST).splitlines()
    except BlockingIOError:  # a process that the command started still holds the pipe open
        return facts
    for line in lines:
        with suppress(ValueError):
            found = json.loads(line)
            facts |= found if isinstance(found, dict) else {}
    return facts
