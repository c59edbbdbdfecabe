"""Write to stdout, and handle its errors: a closed or full stdout, or a reader that has closed the pipe."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from nerfbake.errors import OutputError, PipeClosed, UsageError, printable


def print_text(text: str = "") -> None:
    """Print lines of data, with a space for each character that is not printable, such as a terminal's escapes.

    A name from a file or a command line may contain a line feed: put it on one line first. Raises OutputError if the
    text cannot be written, PipeClosed if the reader closed the pipe.
    """
    _print(printable(text))


def versioned(facts: Mapping[str, Any]) -> dict[str, Any]:
    """Output for scripts, with the version first.

    schemas/json describes the keys. schemas/README.md describes when the version increases.
    """
    return {"version": 1, **facts}


def print_json(facts: Mapping[str, Any]) -> None:
    """Print output for scripts as one line of JSON, with its version. Raises OutputError, PipeClosed."""
    _print(json_line(facts))


def json_line(facts: Mapping[str, Any]) -> str:
    """Output for scripts as one line of JSON, with its version."""
    return json.dumps(versioned(facts)).replace("\x7f", "\\u007f")  # JSON escapes all other controls


def _print(text: str) -> None:
    _require_open("a pipe, a file or a terminal")
    with _blamed():
        sys.stdout.write(f"{text}\n")
        sys.stdout.flush()


def print_names(text: str) -> None:
    """Print a line, with the original bytes of file names. Raises OutputError, PipeClosed."""
    _require_open("a pipe, a file or a terminal")
    with _blamed():
        sys.stdout.buffer.write(os.fsencode(text) + b"\n")
        sys.stdout.buffer.flush()


def write_stdout(pieces: Iterable[bytes | memoryview]) -> int:
    """Write bytes to stdout; return their number. Raises OutputError, PipeClosed; UsageError for a terminal."""
    _require_open("a pipe or a file")
    if sys.stdout.isatty():
        raise UsageError("stdout is a terminal; allowed: a pipe or a file")
    size = 0
    with _blamed():
        for piece in pieces:
            sys.stdout.buffer.write(piece)
            size += len(piece)
        sys.stdout.buffer.flush()
    return size


def _require_open(allowed: str) -> None:
    if sys.stdout is None or sys.stdout.closed:
        raise OutputError(f"is closed; allowed: {allowed}", source="stdout")


@contextmanager
def _blamed() -> Iterator[None]:
    try:
        yield
    except BrokenPipeError:
        raise PipeClosed from None
    except OSError as error:
        raise OutputError(f"{error.strerror or error}", source="stdout") from error
