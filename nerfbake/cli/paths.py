"""Parameter types for paths, which declare what a command reads and writes.

Every path argument and option has one of these types. `nerfbake batch` uses them to collect the inputs and outputs of
all command lines before it runs any of them.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import PurePath
from typing import Any, NamedTuple

import click

from nerfbake import catalog
from nerfbake.io import rejected_path


class DeclaredPaths(NamedTuple):
    """The paths that a command line reads and writes.

    reads   files and folders whose contents are inputs
    albums  captures whose photographs are inputs, too
    writes  files and folders that exist when the command has succeeded
    spare   other paths that it may write: a rejected result, checkpoints
    """

    reads: tuple[str, ...] = ()
    albums: tuple[str, ...] = ()
    writes: tuple[str, ...] = ()
    spare: tuple[str, ...] = ()

    def plus(self, other: DeclaredPaths) -> DeclaredPaths:
        return DeclaredPaths(*(ours + theirs for ours, theirs in zip(self, other, strict=True)))


class Place(click.Path):
    """One or several paths. The empty path is refused: it would be the working folder."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        if value == "":
            self.fail("the path is empty; allowed: a path", param, ctx)
        return super().convert(value, param, ctx)

    def declare(self, paths: tuple[str, ...], options: Mapping[str, Any]) -> DeclaredPaths:
        """Return how a command uses these paths. options: all of its arguments and options by name."""
        raise NotImplementedError


class Reads(Place):
    """A file or folder that the command reads."""

    def declare(self, paths: tuple[str, ...], options: Mapping[str, Any]) -> DeclaredPaths:
        return DeclaredPaths(reads=paths)


class Capture(Reads):
    """Cameras without their photographs. Files that cannot be opened are reported when they are read."""

    def __init__(self) -> None:
        super().__init__(readable=False)


class PhotographsPath(Place):
    """Cameras with their photographs."""

    def declare(self, paths: tuple[str, ...], options: Mapping[str, Any]) -> DeclaredPaths:
        return DeclaredPaths(albums=paths)


class PhotographsWithPoses(Place):
    """A folder of photographs to which the command writes their poses."""

    def declare(self, paths: tuple[str, ...], options: Mapping[str, Any]) -> DeclaredPaths:
        outputs = tuple(str(PurePath(path) / name) for path in paths for name in ("transforms.json", "sparse/0"))
        return DeclaredPaths(reads=paths, writes=outputs)


class Stage1AndFolder(Place):
    """[STAGE1_DIR] OUT_DIR: the command writes the last path."""

    def declare(self, paths: tuple[str, ...], options: Mapping[str, Any]) -> DeclaredPaths:
        return DeclaredPaths(reads=paths[:-1]).plus(JudgedOutput().declare(paths[-1:], options))


class Writes(Place):
    """A file or folder that the command writes."""

    def declare(self, paths: tuple[str, ...], options: Mapping[str, Any]) -> DeclaredPaths:
        return DeclaredPaths(writes=paths)


class JudgedOutput(Writes):
    """An output that is renamed to OUT.rejected if its PSNR is below --min-psnr."""

    def declare(self, paths: tuple[str, ...], options: Mapping[str, Any]) -> DeclaredPaths:
        if options.get("grids") == ("all",):
            raise click.UsageError(
                "--grid all writes files whose names depend on the contents of IN; allowed in a batch: --grid NAME"
            )
        judged = options.get("min_psnr") is not None
        return DeclaredPaths(writes=paths, spare=tuple(map(_rejected, paths)) if judged else ())


def _rejected(path: str) -> str:
    """What an output is renamed to: the folder, if the path is that of its key."""
    return str(rejected_path(path if catalog.folder_of_key(path) is None else str(PurePath(path).parent)))


class MeshOutput(JudgedOutput):
    """A mesh, a volume or another scene, with the files that may stand beside it."""

    def declare(self, paths: tuple[str, ...], options: Mapping[str, Any]) -> DeclaredPaths:
        found = super().declare(paths, options)
        for form in (*catalog.formats_of("Meshes"), *catalog.formats_of("Volume")):
            beside = (
                path[: -len(form.suffix)] + ending for path in paths for ending in form.spread if _ends(path, form)
            )
            found = found.plus(DeclaredPaths(spare=tuple(beside)))
        return found


def _ends(path: str, form: catalog.Format) -> bool:
    return path.lower().endswith(form.suffix)


class StateFolder(Place):
    """A folder for files that only the command itself reads, such as checkpoints."""

    def declare(self, paths: tuple[str, ...], options: Mapping[str, Any]) -> DeclaredPaths:
        return DeclaredPaths(spare=paths)


def declared(command: click.Command, arguments: list[str]) -> DeclaredPaths:
    """Return the paths that a command with these arguments reads and writes. Raises click.UsageError."""
    if not arguments or {"-h", "--help"} & set(arguments):
        raise click.UsageError("only prints its help; allowed: a command with its arguments")
    found = DeclaredPaths()
    with command.make_context(command.name, list(arguments)) as context:
        for param in command.params:
            value = context.params.get(param.name or "")
            if isinstance(param.type, Place) and value:
                found = found.plus(param.type.declare((value,) if isinstance(value, str) else value, context.params))
    return found
