"""What a command reads and writes, told by the types of its arguments and options.

Every path of a command has one of these types; a batch asks them what a line would read and write before it runs any.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import click

from nerfbake.io import rejected_path


class Declared(NamedTuple):
    """What a line reads and writes.

    reads   files and folders whose content counts
    albums  captures, of which the photographs count, too
    writes  files and folders that are there when the line is done
    spare   what it may write beside these: a result that was rejected, checkpoints
    """

    reads: tuple[str, ...] = ()
    albums: tuple[str, ...] = ()
    writes: tuple[str, ...] = ()
    spare: tuple[str, ...] = ()

    def plus(self, other: Declared) -> Declared:
        return Declared(*(ours + theirs for ours, theirs in zip(self, other, strict=True)))


class Place(click.Path):
    """A path, or several."""

    def declare(self, paths: tuple[str, ...], options: Mapping[str, Any]) -> Declared:
        """What a command does with these paths, given all of its options by their names."""
        raise NotImplementedError


class Reads(Place):
    """A file or a folder that is read."""

    def declare(self, paths: tuple[str, ...], options: Mapping[str, Any]) -> Declared:
        return Declared(reads=paths)


class Capture(Reads):
    """Cameras: of a file its text alone counts. What cannot be opened is told by whoever opens it."""

    def __init__(self) -> None:
        super().__init__(readable=False)


class Photographs(Place):
    """A capture with its photographs."""

    def declare(self, paths: tuple[str, ...], options: Mapping[str, Any]) -> Declared:
        return Declared(albums=paths)


class Stage1AndFolder(Place):
    """[STAGE1_DIR] OUT_DIR: the last one is written."""

    def declare(self, paths: tuple[str, ...], options: Mapping[str, Any]) -> Declared:
        return Declared(reads=paths[:-1]).plus(Output().declare(paths[-1:], options))


class Writes(Place):
    """A file or a folder that is written."""

    def declare(self, paths: tuple[str, ...], options: Mapping[str, Any]) -> Declared:
        return Declared(writes=paths)


class Output(Writes):
    """What is judged where --min-psnr is given, and becomes OUT.rejected where it is worse."""

    def declare(self, paths: tuple[str, ...], options: Mapping[str, Any]) -> Declared:
        if options.get("grids") == ("all",):
            raise click.UsageError("--grid all writes files that only IN names; allowed in a batch: --grid NAME")
        judged = options.get("min_psnr") is not None
        return Declared(writes=paths, spare=tuple(str(rejected_path(path)) for path in paths) if judged else ())


class Keeps(Place):
    """A folder where a command keeps what only itself reads."""

    def declare(self, paths: tuple[str, ...], options: Mapping[str, Any]) -> Declared:
        return Declared(spare=paths)


def declared(command: click.Command, arguments: list[str]) -> Declared:
    """What a command with these arguments would read and write. Raises click.UsageError where they are wrong."""
    if not arguments or {"-h", "--help"} & set(arguments):
        raise click.UsageError("only says what it does; allowed: a command with its arguments")
    found = Declared()
    with command.make_context(command.name, list(arguments)) as context:
        for param in command.params:
            value = context.params.get(param.name or "")
            if isinstance(param.type, Place) and value:
                found = found.plus(param.type.declare((value,) if isinstance(value, str) else value, context.params))
    return found
