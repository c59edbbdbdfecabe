"""Command lines as text: a template with inputs, and a file of lines.

    svo {in} baked/{stem}.svo.pb --resolution 256

A line is split as a shell splits it, by spaces and quotes, before anything is put in: names may have spaces, quotes,
line breaks and braces. Nothing else that a shell does is done: no variables, no patterns, no pipes.
"""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator, Sequence
from pathlib import PurePath
from typing import NamedTuple

from nerfbake.catalog import FORMATS, uncompressed
from nerfbake.errors import UsageError

_BRACES = re.compile(r"\{\{|\}\}|\{[^{}]*\}|[{}]")
_ENDINGS = sorted({form.suffix for form in FORMATS}, key=len, reverse=True)


class Line(NamedTuple):
    """A command line without `nerfbake`, and where it comes from, for errors."""

    argv: tuple[str, ...]
    place: str


def fill_template(template: str, inputs: Sequence[str]) -> list[Line]:
    """A line for each input.

    {in} is the input as it is given, {name} its last part, {stem} this without the ending of a format, {dir} the folder
    that it is in; {{ and }} are braces. Raises UsageError for another placeholder, and where none is {in}.
    """
    place = "the template"
    words = _split(template, place)
    known = ", ".join(f"{{{name}}}" for name in _parts("a"))
    found = {part for word in words for part in _BRACES.findall(word)} - {"{{", "}}"}
    for part in sorted(found - {f"{{{name}}}" for name in _parts("a")}):
        raise UsageError(f"{place} has {part!r}; allowed: {known}, and {{{{ or }}}} for a brace")
    if "{in}" not in found:
        raise UsageError(f"{place} has no {{in}}; allowed: 'svo {{in}} {{stem}}.svo.pb', for example")
    return [Line(tuple(_filled(word, _parts(path)) for word in words), f"input {path!r}") for path in inputs]


def parse_lines(text: str, name: str) -> Iterator[Line]:
    """The command lines of a file, each with or without a leading `nerfbake`. Empty lines and those that start with #
    are passed over; a line goes on in the next where a quote is open, or behind a backslash. Raises UsageError.
    """
    begun, start, quote = "", 0, ""
    for number, line in enumerate(text.split("\n"), 1):
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
            yield Line(tuple(words[1:] if words[:1] == ["nerfbake"] else words), f"{name}, line {start}")
    if begun:
        raise _wrong(f"{name}, line {start}", "no closing quotation" if quote else "no end")


def _open_at_end(line: str, quote: str) -> tuple[str, bool]:
    """The quote that is open behind a line which begins within this one ('' for none), and whether a backslash is."""
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
        raise _wrong(place, "a NUL")
    try:
        return shlex.split(text)
    except ValueError as error:
        raise _wrong(place, str(error).lower()) from None


def _wrong(place: str, found: str) -> UsageError:
    return UsageError(f"{place} has {found}; allowed: a command line, quoted as for a shell")


def _parts(path: str) -> dict[str, str]:
    pure = PurePath(path)
    return {"in": path, "name": pure.name, "stem": _stem(pure.name), "dir": str(pure.parent)}


def _stem(name: str) -> str:
    bare = uncompressed(name)
    ending = next((ending for ending in _ENDINGS if bare.lower().endswith(ending)), PurePath(bare).suffix)
    return bare.removesuffix(bare[len(bare) - len(ending) :]) or name


def _filled(word: str, parts: dict[str, str]) -> str:
    return _BRACES.sub(lambda found: parts.get(found[0].strip("{}"), found[0][0]), word)
