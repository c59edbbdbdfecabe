"""What the commands of `nerfbake bench` share: how often they measure, and where their report and chart go."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click

from nerfbake import io
from nerfbake.bench.extras import require_installed
from nerfbake.cli.params import Command, without_effect
from nerfbake.cli.paths import Writes
from nerfbake.errors import OutputError, UsageError


@dataclass(frozen=True)
class Destination:
    """Where a report goes, spelled how, and its chart."""

    kind: str
    output: str | None
    plot: str | None
    force: bool

    def require(self) -> None:
        """Raises, before anything is measured, if it could not be written."""
        if self.plot:
            require_chart(self.plot, force=self.force)
        if self.output:
            io.require_absent(self.output, force=self.force)

    def write(self, reports: Sequence[Any], chart: Callable[[Any, str], bytes]) -> None:
        """All reports as one document, and the chart of the first."""
        from nerfbake.bench.report import document

        text = document(reports, self.kind)
        if self.output:
            save_bytes(self.output, text.encode(), force=self.force)
        else:
            io.print_text(text.removesuffix("\n"))
        if self.plot:
            save_bytes(self.plot, chart(reports[0], Path(self.plot).suffix), force=self.force)


def require_chart(path: str, *, force: bool) -> None:
    """Raises, before anything is measured, if no chart could be drawn here."""
    if Path(path).suffix not in (".png", ".svg"):
        raise UsageError(f"the ending of {path!r} names no picture; allowed: .png, .svg")
    require_installed("matplotlib", "--plot")
    io.require_absent(path, force=force)


def save_bytes(path: str, content: bytes, *, force: bool) -> None:
    """A report or a chart: whole or not at all."""
    with io.blame(path, OutputError), io.replacing(Path(path), force=force) as file:
        file.write(content)


def reports(*, rounds: int, chart: str) -> Callable[[Command], Command]:
    """Adds --rounds, and --format, -o, --plot and --force, which the command gets as `destination`."""

    def add(function: Command) -> Command:
        @click.option(
            "--rounds",
            type=click.IntRange(1, 1000),
            default=rounds,
            show_default=True,
            help="How many runs are counted.",
        )
        @click.option(
            "--format",
            "kind",
            type=click.Choice(["md", "csv", "json"]),
            default="md",
            show_default=True,
            help="The form of the report.",
        )
        @click.option(
            "-o", "--output", type=Writes(), help="The file that the report is written to.  [default: stdout]"
        )
        @click.option("--plot", type=Writes(), help=f"Draw a chart of {chart}, as .png or .svg.")
        @click.option("--force", is_flag=True, help="Replace files that exist.")
        @functools.wraps(function)
        def command(*args: Any, kind: str, output: str | None, plot: str | None, force: bool, **others: Any) -> Any:
            if not (output or plot):
                without_effect("force", here="where no file is written", allowed="--force with -o or --plot")
            destination = Destination(kind, output, plot, force)
            destination.require()
            return function(*args, destination=destination, **others)

        return command

    return add


class Resolutions(click.ParamType[tuple[int, ...]]):
    """Voxels an axis, one or several."""

    name = "R,..."

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[int, ...]:
        if isinstance(value, tuple):
            return value
        edges = value.split(",")
        if not all(edge.isdecimal() and len(edge) < 5 and 1 <= int(edge) <= 4096 for edge in edges):
            self.fail(f"{value!r} are no resolutions; allowed: R,R,..., each 1 to 4096", param, ctx)
        return tuple(dict.fromkeys(map(int, edges)))
