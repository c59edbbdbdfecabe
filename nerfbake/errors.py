"""Exceptions with one-line messages, and the exit codes of the command line.

| exit code | meaning |
|---|---|
| 0 | success |
| 1 | bad input: an invalid file or scene (`NerfbakeError`) |
| 2 | wrong usage: an unknown option, format or extension, or a missing library (`UsageError`, click's own errors) |
| 3 | a quality limit is missed (`BudgetMissed`) |
| 4 | the output cannot be written (`OutputError`); an existing output is unchanged |
| 70 | a bug in nerfbake: please report it |
| 130, 141, 143 | stopped by Ctrl-C, by a reader that closed the pipe, by SIGTERM |
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from typing import NamedTuple

_ALLOWED = "; allowed: "  # separates what was found from what is allowed


class Problem(NamedTuple):
    """One defect: its place, what was found, what is allowed, and how often it occurs."""

    place: str
    found: str
    allowed: str
    times: int = 1

    def __str__(self) -> str:
        more = f" (and {self.times - 1:,} more)" if self.times > 1 else ""
        return f"{self.place} {self.found}{_ALLOWED}{self.allowed}{more}"

    @property
    def line(self) -> str:
        """One printable line, whatever bytes the file contains."""
        return one_line(str(self))


LONGEST_LINE = 300  # characters: one or two lines of a terminal


def one_line(text: str, longest: int = LONGEST_LINE) -> str:
    """Return at most `longest` printable characters.

    The part before `; allowed: ` is shortened in its middle; `; allowed: ` is kept.
    """
    found, mark, allowed = text.rpartition(_ALLOWED)
    allowed = _shortened(allowed, max(longest * 2 // 5, longest - len(found) - len(mark)) if mark else longest)
    return _shortened(found, longest - len(mark + allowed)) + mark + allowed


def printable(text: str) -> str:
    """Return the text with a space for each character that is not printable, except line feeds."""
    return "".join(char if char.isprintable() or char == "\n" else " " for char in text)


def _shortened(text: str, longest: int) -> str:
    """Return printable characters. Text that is too long keeps its first two thirds and its end."""
    if len(text) > 4 * longest:
        text = text[: 2 * longest] + text[-2 * longest :]
    line = " ".join(printable(text).split())
    if len(line) <= longest:
        return line
    first = longest * 2 // 3
    return f"{line[:first]} ... {line[len(line) - (longest - first - 5) :]}"


_ARGUMENT = re.compile(r"`([a-z][a-z0-9_]*)(?:=([^`]*))?`")
_OPTIONS = {"memory_limit": "max-memory"}  # arguments whose option has another name


def for_shell(text: str) -> str:
    """Return the text with --force for `force`, and --grid NAME for `grid=NAME`."""

    def option(argument: re.Match[str]) -> str:
        name = _OPTIONS.get(argument[1], argument[1].replace("_", "-"))
        return f"--{name}" if argument[2] is None else f"--{name} {argument[2]}"

    return _ARGUMENT.sub(option, text)


class NerfbakeError(Exception):
    """Base class of every error that nerfbake raises on purpose.

    str() is one line that names arguments in backticks. `line` is the same with the options of the command line. The
    functions that read and write files add the file's name.

    >>> from nerfbake import NerfbakeError, load
    >>> try:
    ...     load("missing.npz")
    ... except NerfbakeError as error:
    ...     print(error.exit_code, error)
    1 missing.npz: No such file or directory
    """

    exit_code = 1

    def __init__(self, what: str | Problem, *, source: str | None = None) -> None:
        super().__init__(what)
        self.what = what
        self.source = source

    @property
    def problem(self) -> Problem:
        """The error as place, found and allowed, for scripts."""
        if isinstance(self.what, Problem):
            return self.what
        found, _, allowed = self.what.partition(_ALLOWED)
        found = f"cannot be read: {found}" if found[:1].isupper() else found  # a message of the system has no verb
        return Problem("file", found, allowed or "a file that nerfbake reads")

    def __str__(self) -> str:
        return self._after_source(one_line(str(self.what)))

    @property
    def line(self) -> str:
        """The line for a shell, with `--options`."""
        return self._after_source(one_line(for_shell(str(self.what))))

    def _after_source(self, line: str) -> str:
        return f"{self.source}: {line}" if self.source else line


class UsageError(NerfbakeError):
    """A command or call with an unknown option, format or value."""

    exit_code = 2


class InvalidFile(NerfbakeError):
    """A file whose bytes are not valid in its format."""


@contextmanager
def within(name: str) -> Iterator[None]:
    """Add the name of a file in a folder to the place of an InvalidFile error."""
    try:
        yield
    except InvalidFile as error:
        if error.source is None:
            error.what = error.problem._replace(place=f"{name}: {error.problem.place}")
        raise


@contextmanager
def without(name: str) -> Iterator[None]:
    """Remove the name of a file from the place of errors, to which its path is added."""
    try:
        yield
    except NerfbakeError as error:
        if error.source is None and isinstance(error.what, Problem):
            place, found, allowed, _ = error.what
            if place == name:
                error.what = f"{found}{_ALLOWED}{allowed}"
            elif place.startswith(f"{name}: "):
                error.what = error.what._replace(place=place[len(name) + 2 :])
        raise


class InvalidScene(NerfbakeError):
    """Arrays that are not valid for their scene type, or a stage without a result."""


class MemoryLimit(NerfbakeError):
    """A file or a result that would exceed the memory limit."""

    def __init__(self, what: str, need: int, limit: int, *, beside: int = 0) -> None:
        others = f" in addition to {format_size(beside)} in use" if beside else ""
        super().__init__(Problem(what, f"needs {format_size(need)}{others}", f"{format_size(limit)} (`memory_limit`)"))


class DeviceError(NerfbakeError):
    """A graphics device that fails: lost, out of memory, too small for a buffer, or without an answer.

    The CPU does the same work, so most callers go on without the device.
    """


class BudgetMissed(NerfbakeError):
    """A result that loses more quality than the caller allows."""

    exit_code = 3


class OutputError(NerfbakeError):
    """An output that cannot be written, or must not be replaced."""

    exit_code = 4


class Stopped(NerfbakeError):
    """Ctrl-C, raised after the intermediate result has been written."""

    exit_code = 130


class PipeClosed(NerfbakeError):
    """The reader of stdout has closed the pipe."""

    exit_code = 141

    def __init__(self) -> None:
        super().__init__("the reader of stdout has closed it")


def format_size(size: float) -> str:
    """Format a size in bytes for people: 1536 -> '1.5 KiB'."""
    for unit in ("B", "KiB", "MiB", "GiB", "TiB"):
        if size < 1024 or unit == "TiB":
            break
        size /= 1024
    return f"{size:.0f} {unit}" if unit == "B" else f"{size:.1f} {unit}"
