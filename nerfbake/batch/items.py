"""What a batch is made of, and what may not stand in one batch."""

from __future__ import annotations

import os
import shlex
from collections.abc import Iterator, Sequence
from pathlib import PurePath
from typing import NamedTuple

from nerfbake.errors import UsageError, one_line
from nerfbake.io import STREAM, rejected_path


class Item(NamedTuple):
    """A command line of nerfbake, and what it reads and writes.

    argv    the words after `nerfbake`
    reads   files and folders whose content counts
    writes  files and folders that are there when it is done
    albums  captures of which the photographs count, too: those in a folder, or beside and below a file
    spare   what it may write beside: a result that was rejected, checkpoints
    """

    argv: tuple[str, ...]
    reads: tuple[str, ...] = ()
    writes: tuple[str, ...] = ()
    albums: tuple[str, ...] = ()
    spare: tuple[str, ...] = ()

    @property
    def line(self) -> str:
        """The whole command line, which a shell takes, and parse_lines() again."""
        return shlex.join(("nerfbake", *self.argv))

    @property
    def pasteable(self) -> str:
        """The same on one line, in letters that every terminal and page has: for bash and zsh."""
        return " ".join(map(_pasteable, ("nerfbake", *self.argv)))

    @property
    def name(self) -> str:
        """What a terminal calls it: its first input."""
        return one_line(PurePath(*(*self.reads, *self.albums, *self.argv)[:1]).name, 40)

    @property
    def rejected(self) -> tuple[str, ...]:
        """Of `spare`, what an output becomes that misses its budget."""
        names = {str(rejected_path(path)) for path in self.writes}
        return tuple(path for path in self.spare if path in names)

    def forced(self) -> tuple[str, ...]:
        """argv, which replaces what it finds."""
        at = self.argv.index("--") if "--" in self.argv else len(self.argv)
        return (*self.argv[:at], "--force", *self.argv[at:])


def _pasteable(word: str) -> str:
    if word.isprintable():
        return shlex.quote(word)
    letters = (chr(byte) if 32 <= byte < 127 and chr(byte) not in "\\'" else f"\\x{byte:02x}" for byte in _bytes(word))
    return f"$'{''.join(letters)}'"


def _bytes(word: str) -> bytes:
    return word.encode("utf-8", "surrogateescape")


_SEVERAL = -1


def require_apart(items: Sequence[Item], keep: Sequence[str] = ()) -> None:
    """Raises UsageError where two items write the same, where one writes what another or itself reads, and where one
    writes `keep`, or a folder around it: all of it would go wrong at some time, depending on who comes first.
    """
    writers: dict[str, int] = {}
    for number, item in enumerate(items):
        require_names(item)
        for path in (*item.writes, *item.spare):
            if (other := writers.setdefault(_real(path), number)) != number:
                raise _clash(items, number, f"writes {path!r}, as {_told(items, other)} does", "an output of its own")
    readers: dict[str, int] = {}
    for number, item in enumerate(items):
        for path in (*item.reads, *item.albums):
            real = _real(path)
            readers[real] = _SEVERAL if readers.get(real, number) != number else number
            if (writer := _writer_of(real, writers)) is not None:
                raise _clash(items, writer, f"writes {path!r}, which {_told(items, number)} reads", "another output")
    for path, number in writers.items():
        for folder in _around(path):
            if readers.get(folder, number) != number:
                raise _clash(items, number, f"writes into {folder!r}, which others read", "an output elsewhere")
            if writers.get(folder, number) != number:
                raise _clash(items, number, f"writes into {folder!r}, which another writes", "an output elsewhere")
    for path in keep:
        if (writer := _writer_of(_real(path), writers)) is not None:
            raise _clash(items, writer, f"writes {path!r}, which belongs to the batch", "an output elsewhere")


def require_names(item: Item) -> None:
    """Raises UsageError for a stream, which a batch has not, and for a word that no process can be given."""
    if STREAM in (*item.reads, *item.albums, *item.writes, *item.spare):
        raise UsageError(f"{item.pasteable}: reads or writes a stream; allowed in a batch: files and folders")
    for word in (*item.argv, *item.reads, *item.albums, *item.writes, *item.spare):
        if "\0" in word:
            raise UsageError(f"{word!r} has a NUL; allowed: words and names without one")


def _writer_of(path: str, writers: dict[str, int]) -> int | None:
    """Who writes this, or a folder around it."""
    return next((writers[place] for place in (path, *_around(path)) if place in writers), None)


def _around(path: str) -> Iterator[str]:
    return map(str, PurePath(path).parents)


def _real(path: str) -> str:
    return os.path.realpath(path)


def _told(items: Sequence[Item], number: int) -> str:
    return f"item {number + 1} ({one_line(items[number].pasteable, 80)})"


def _clash(items: Sequence[Item], number: int, found: str, allowed: str) -> UsageError:
    return UsageError(f"{_told(items, number)} {found}; allowed: {allowed}")
