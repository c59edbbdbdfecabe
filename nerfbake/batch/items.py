"""Items of a batch: parse command lines, and check that they do not conflict.

Command lines come from a file, or from a template that is filled with each input:

    svo {in} baked/{stem}.svo.pb --resolution 256

A line is split at spaces and quotes, as in a shell, before the placeholders are filled: file names may contain spaces,
quotes, line breaks and braces. $'...' may have the escapes \\xNN, which Item.line writes for characters that are not
printable. No other shell syntax is supported: no variables, no patterns, no pipes.
"""

from __future__ import annotations

import os
import re
import shlex
from collections.abc import Iterator, Sequence
from pathlib import PurePath
from typing import NamedTuple

from nerfbake.catalog import format_suffix, uncompressed
from nerfbake.errors import UsageError, one_line
from nerfbake.io import STREAM, rejected_path


class Item(NamedTuple):
    """A command line of nerfbake, with the paths that it reads and writes.

    argv    the arguments after `nerfbake`
    reads   files and folders that it reads
    writes  files and folders that exist when it is done
    albums  captures that it reads with their photographs: those in a folder, or beside and below a file
    spare   further paths that it may write: a rejected output, checkpoints
    """

    argv: tuple[str, ...]
    reads: tuple[str, ...] = ()
    writes: tuple[str, ...] = ()
    albums: tuple[str, ...] = ()
    spare: tuple[str, ...] = ()

    @property
    def line(self) -> str:
        """The whole command line on one line, quoted for bash, zsh and parse_lines().

        Characters that are not printable have escapes.
        """
        return " ".join(map(_pasteable, ("nerfbake", *self.argv)))

    @property
    def name(self) -> str:
        """A short name for terminals: the file name of the first input."""
        return one_line(PurePath(*(*self.reads, *self.albums, *self.argv)[:1]).name, 40)

    @property
    def rejected(self) -> tuple[str, ...]:
        """The paths in `spare` that rejected outputs are written to."""
        names = {str(rejected_path(path)) for path in self.writes}
        return tuple(path for path in self.spare if path in names)

    def forced(self) -> tuple[str, ...]:
        """argv with --force, which replaces existing outputs."""
        at = self.argv.index("--") if "--" in self.argv else len(self.argv)
        return (*self.argv[:at], "--force", *self.argv[at:])


def _pasteable(word: str) -> str:
    if word.isprintable():
        return shlex.quote(word)
    data = word.encode("utf-8", "surrogateescape")
    letters = (chr(byte) if 32 <= byte < 127 and chr(byte) not in "\\'" else f"\\x{byte:02x}" for byte in data)
    return f"$'{''.join(letters)}'"


_SEVERAL = -1  # number of the item for a path that several items read


def require_apart(items: Sequence[Item], keep: Sequence[str] = ()) -> None:
    """Check that the result does not depend on the order in which the items run. Call it before running them.

    Raises UsageError if two items write the same path, if an item writes a path that it or another item reads, or if
    an item writes a path in `keep` or a folder around one.
    """
    writers: dict[str, int] = {}
    for number, item in enumerate(items):
        require_names(item)
        for path in (*item.writes, *item.spare):
            if (other := writers.setdefault(_real(path), number)) != number:
                raise _conflict(items, number, f"writes {path!r}, as {_label(items, other)} does", "another output")
    readers: dict[str, int] = {}
    for number, item in enumerate(items):
        for path in (*item.reads, *item.albums):
            real = _real(path)
            readers[real] = _SEVERAL if readers.get(real, number) != number else number
            if (writer := _writer_of(real, writers)) is not None:
                found = f"writes {path!r}, which {_label(items, number)} reads"
                raise _conflict(items, writer, found, "another output")
    for path, number in writers.items():
        for folder in _parents(path):
            if readers.get(folder, number) != number:
                raise _conflict(items, number, f"writes into {folder!r}, which another item reads", "another folder")
            if writers.get(folder, number) != number:
                raise _conflict(items, number, f"writes into {folder!r}, which another item writes", "another folder")
    for path in keep:
        if (writer := _writer_of(_real(path), writers)) is not None:
            raise _conflict(items, writer, f"writes {path!r}, which belongs to the batch", "another output")


def require_names(item: Item) -> None:
    """Raise UsageError if the item reads or writes a stream, or if an argument or path contains NUL."""
    if STREAM in (*item.reads, *item.albums, *item.writes, *item.spare):
        raise UsageError(f"{item.line}: reads or writes a stream; allowed in a batch: files and folders")
    for word in (*item.argv, *item.reads, *item.albums, *item.writes, *item.spare):
        if "\0" in word:
            raise UsageError(f"{word!r} has a NUL; allowed: arguments and paths without one")


def _writer_of(path: str, writers: dict[str, int]) -> int | None:
    """The number of the item that writes this path or a folder around it; None if no item does."""
    return next((writers[place] for place in (path, *_parents(path)) if place in writers), None)


def _parents(path: str) -> Iterator[str]:
    return map(str, PurePath(path).parents)


def _real(path: str) -> str:
    return os.path.realpath(path)


def _label(items: Sequence[Item], number: int) -> str:
    """The name of an item in errors: its number, from 1, and its command line."""
    return f"item {number + 1} ({one_line(items[number].line, 80)})"


def _conflict(items: Sequence[Item], number: int, found: str, allowed: str) -> UsageError:
    return UsageError(f"{_label(items, number)} {found}; allowed: {allowed}")


_BRACES = re.compile(r"\{\{|\}\}|\{[^{}]*\}|[{}]")


class CommandLine(NamedTuple):
    """The arguments of a command line without `nerfbake`, and its source for errors."""

    argv: tuple[str, ...]
    place: str


def fill_template(template: str, inputs: Sequence[str]) -> list[CommandLine]:
    """Return a command line for each input.

    {in} is replaced by the input, {name} by its last path component, {stem} by that name without the extension of its
    format, and {dir} by its folder. {{ and }} stand for braces. Raises UsageError for other placeholders, or if the
    template has no {in}.
    """
    place = "the template"
    words = _split(template, place)
    known = ", ".join(f"{{{name}}}" for name in _fields("a"))
    found = {part for word in words for part in _BRACES.findall(word)} - {"{{", "}}"}
    for part in sorted(found - {f"{{{name}}}" for name in _fields("a")}):
        raise UsageError(f"{place} has {part!r}; allowed: {known}, and {{{{ or }}}} for a brace")
    if "{in}" not in found:
        raise UsageError(f"{place} has no {{in}}; allowed: 'svo {{in}} {{stem}}.svo.pb', for example")
    return [CommandLine(tuple(_fill(word, _fields(path)) for word in words), f"input {path!r}") for path in inputs]


def parse_lines(text: str, name: str) -> Iterator[CommandLine]:
    """Parse the command lines of a file, each with or without a leading `nerfbake`.

    Empty lines and lines that start with # are skipped. A command line continues on the next line inside quotes, or
    after a backslash. name: the name of the file in errors. Raises UsageError.
    """
    begun, start, quote = "", 0, ""
    for number, line in enumerate(text.removeprefix("\ufeff").split("\n"), 1):  # editors on Windows write this mark
        if not begun:
            start = number
            if not line.strip() or line.lstrip().startswith("#"):
                continue
        quote, escaped = _open_at_end(line, quote)
        if escaped and not quote:
            begun += line[:-1]
        elif quote:
            begun += f"{line}\n"
        else:
            words, begun = _split(begun + line, f"{name}, line {start}"), ""
            yield CommandLine(tuple(words[1:] if words[:1] == ["nerfbake"] else words), f"{name}, line {start}")
    if begun:
        raise _line_error(f"{name}, line {start}", "no closing quotation" if quote else "no end")


def _open_at_end(line: str, quote: str) -> tuple[str, bool]:
    """The quote that is open at the end of a line ('' for none), and whether the line ends with a backslash.

    quote: the quote that is open at its start.
    """
    escaped = False
    for letter in line:
        if escaped:
            escaped = False
        elif letter == "\\" and quote != "'":
            escaped = True
        elif quote:
            quote = "" if letter == quote else quote
        elif letter in "'\"":
            quote = letter
    return quote, escaped


def _split(text: str, place: str) -> list[str]:
    if "\0" in text:
        raise _line_error(place, "a NUL")
    try:
        return shlex.split(_ESCAPED.sub(_unescaped, text))
    except ValueError as error:
        raise _line_error(place, str(error).lower()) from None


# A quoted part, which stays as it is, or $'...' with the escapes that Item.line writes.
_ESCAPED = re.compile(r"""(?:"(?:[^"\\]|\\.)*"|\\.|(?<!\$)'[^']*')|\$'((?:[^'\\]|\\x[0-9a-f]{2})*)'""", re.DOTALL)


def _unescaped(found: re.Match[str]) -> str:
    """Quote what $'...' stands for, as shlex understands it."""
    if found[1] is None:
        return found[0]
    data = re.sub(rb"\\x(..)", lambda byte: bytes([int(byte[1], 16)]), os.fsencode(found[1]))
    return shlex.quote(os.fsdecode(data))


def _line_error(place: str, found: str) -> UsageError:
    return UsageError(f"{place} has {found}; allowed: a command line, quoted as for a shell")


def _fields(path: str) -> dict[str, str]:
    """The values of the placeholders for an input."""
    pure = PurePath(path)
    return {"in": path, "name": pure.name, "stem": _stem(pure.name), "dir": str(pure.parent)}


def _stem(name: str) -> str:
    bare = uncompressed(name)
    suffix = format_suffix(bare) or PurePath(bare).suffix
    return bare[: len(bare) - len(suffix)] or name


def _fill(word: str, parts: dict[str, str]) -> str:
    return _BRACES.sub(lambda found: parts.get(found[0].strip("{}"), found[0][0]), word)
