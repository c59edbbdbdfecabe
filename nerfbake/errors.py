"""What can go wrong, said in one line, with the exit code that a shell sees.

| exit code | meaning |
|---|---|
| 0 | done |
| 1 | bad input: a file or scene that cannot be right (`NerfbakeError`) |
| 2 | wrong usage: an option, a format, an ending or a library that there is not (`UsageError`, click's own) |
| 3 | a quality budget is missed (`BudgetMissed`) |
| 4 | the output cannot be written (`OutputError`); what stood there before is untouched |
| 70 | a fault of nerfbake's own: please report it |
| 130, 141, 143 | stopped by Ctrl-C, by a reader that closed the pipe, by SIGTERM |
"""

from __future__ import annotations

import re
from typing import NamedTuple

_ALLOWED = "; allowed: "  # between what was found and what is allowed


class Problem(NamedTuple):
    """One thing that is wrong: where, what was found, what is allowed, and how often."""

    place: str
    found: str
    allowed: str
    times: int = 1

    def __str__(self) -> str:
        more = f" (and {self.times - 1:,} more)" if self.times > 1 else ""
        return f"{self.place} {self.found}{_ALLOWED}{self.allowed}{more}"

    @property
    def line(self) -> str:
        """As one line, whatever a hostile file put into it."""
        return one_line(str(self))


LONGEST_LINE = 300  # characters: a terminal's line or two


def one_line(text: str, longest: int = LONGEST_LINE) -> str:
    """At most `longest` printable characters. What was found is shortened in its middle; `; allowed: ` stays."""
    found, mark, allowed = text.rpartition(_ALLOWED)
    allowed = _shortened(allowed, max(longest * 2 // 5, longest - len(found) - len(mark)) if mark else longest)
    return _shortened(found, longest - len(mark + allowed)) + mark + allowed


def _shortened(text: str, longest: int) -> str:
    """Printable characters; the first two thirds and the end where there are too many."""
    if len(text) > 4 * longest:
        text = text[: 2 * longest] + text[-2 * longest :]
    line = " ".join("".join(char if char.isprintable() else " " for char in text).split())
    if len(line) <= longest:
        return line
    first = longest * 2 // 3
    return f"{line[:first]} ... {line[len(line) - (longest - first - 5) :]}"


_ARGUMENT = re.compile(r"`([a-z][a-z0-9_]*)(?:=([^`]*))?`")
_OPTIONS = {"memory_limit": "max-memory"}  # arguments that the command line names otherwise


def for_shell(text: str) -> str:
    """The same with --force for `force`, and with --grid NAME for `grid=NAME`."""

    def option(argument: re.Match[str]) -> str:
        name = _OPTIONS.get(argument[1], argument[1].replace("_", "-"))
        return f"--{name}" if argument[2] is None else f"--{name} {argument[2]}"

    return _ARGUMENT.sub(option, text)


class NerfbakeError(Exception):
    """The parent of every error that nerfbake raises on purpose.

    str() is one line, which names arguments in backticks. `line` names the command line's options instead. `io` adds
    the name of the file that is to blame.

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
        """The same as place, found and allowed, for scripts."""
        if isinstance(self.what, Problem):
            return self.what
        found, _, allowed = self.what.partition(_ALLOWED)
        return Problem("file", found, allowed or "a file that nerfbake reads")

    def __str__(self) -> str:
        return self._after_source(one_line(str(self.what)))

    @property
    def line(self) -> str:
        """The one line that a shell shows, with `--options`."""
        return self._after_source(one_line(for_shell(str(self.what))))

    def _after_source(self, line: str) -> str:
        return f"{self.source}: {line}" if self.source else line


class UsageError(NerfbakeError):
    """A command or call that asks for what there is not."""

    exit_code = 2


class InvalidFile(NerfbakeError):
    """Bytes that are not what they claim to be."""


class InvalidScene(NerfbakeError):
    """Arrays that break the rules of their type, or a stage that has nothing to give back."""


class MemoryLimit(NerfbakeError):
    """A file or a result that would take more memory than the caller allowed."""

    def __init__(self, what: str, need: int, limit: int, *, beside: int = 0) -> None:
        others = f" beside {format_size(beside)} that are taken" if beside else ""
        super().__init__(Problem(what, f"needs {format_size(need)}{others}", f"{format_size(limit)} (`memory_limit`)"))


class BudgetMissed(NerfbakeError):
    """A result that costs more quality than the caller allowed."""

    exit_code = 3


class OutputError(NerfbakeError):
    """An output that cannot be written, or must not be."""

    exit_code = 4


class Stopped(NerfbakeError):
    """Ctrl-C, after which what there was has been written."""

    exit_code = 130


class PipeClosed(NerfbakeError):
    """Whoever read our stdout has seen enough."""

    exit_code = 141

    def __init__(self) -> None:
        super().__init__("the reader of stdout has closed it")


def format_size(size: float) -> str:
    """A size in bytes, for people: 1536 -> '1.5 KiB'."""
    for unit in ("B", "KiB", "MiB", "GiB", "TiB"):
        if size < 1024 or unit == "TiB":
            break
        size /= 1024
    return f"{size:.0f} {unit}" if unit == "B" else f"{size:.1f} {unit}"
