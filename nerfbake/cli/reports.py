"""Options that the commands of `nerfbake bench` share: number of rounds, report and chart."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click

from nerfbake import io
from nerfbake.cli.params import Command, ParamType, bundled, is_whole, without_effect
from nerfbake.cli.paths import Writes
from nerfbake.errors import OutputError, UsageError
from nerfbake.installation import require_installed


@dataclass(frozen=True, kw_only=True)
class Destination:
    """Paths and format of a report, and the path of its chart."""

    kind: str
    output: str | None = None
    plot: str | None = None
    force: bool = False

    def require(self) -> None:
        """Raise NerfbakeError if the report or the chart could not be written. Call it before measuring."""
        if self.plot:
            require_chart(self.plot, force=self.force)
        if self.output:
            io.require_absent(self.output, force=self.force)

    def write(self, reports: Sequence[Any], chart: Callable[[Any, str], bytes]) -> None:
        """Write all reports as one document, and the chart of the first report."""
        from nerfbake.bench.report import document

        text = document(reports, self.kind)
        if self.output:
            save_bytes(self.output, text.encode(), force=self.force)
        else:
            io.print_text(text.removesuffix("\n"))
        if self.plot:
            save_bytes(self.plot, chart(reports[0], Path(self.plot).suffix), force=self.force)


def require_chart(path: str, *, force: bool) -> None:
    """Raise NerfbakeError if no chart could be written to this path. Call it before measuring."""
    if Path(path).suffix not in (".png", ".svg"):
        raise UsageError(f"the extension of {path!r} is not that of a chart; allowed: .png, .svg")
    require_installed("matplotlib", "--plot")
    io.require_absent(path, force=force)


def save_bytes(path: str, content: bytes, *, force: bool) -> None:
    """Write a report or a chart, completely or not at all."""
    with io.blame(path, OutputError), io.replacing(Path(path), force=force) as file:
        file.write(content)


def _check_destination(destination: Destination) -> None:
    if not (destination.output or destination.plot):
        without_effect("force", here="without -o or --plot", allowed="--force with -o or --plot")
    destination.require()


def report_options(*, rounds: int | None, chart: str) -> Callable[[Command], Command]:
    """Add --rounds, --format, -o, --plot and --force; pass the command `rounds` and `destination`, a Destination.

    rounds: the default of --rounds; None: without that option.
    """
    measured = click.option(
        "--rounds",
        type=click.IntRange(1, 1000),
        default=rounds,
        show_default=True,
        help="Number of measured runs.",
    )
    return bundled(
        "destination",
        "cli.reports.Destination",
        *([] if rounds is None else [measured]),
        click.option(
            "--format",
            "kind",
            type=click.Choice(["md", "csv", "json"]),
            default="md",
            show_default=True,
            help="Format of the report.",
        ),
        click.option("-o", "--output", type=Writes(), help="Write the report to this file.  [default: stdout]"),
        click.option("--plot", type=Writes(), help=f"Write a chart of {chart}: a .png or .svg."),
        click.option("--force", is_flag=True, help="Replace existing files."),
        check=_check_destination,
    )


class Resolutions(ParamType[tuple[int, ...]]):
    """One or several resolutions, in voxels along each axis."""

    name = "R,..."

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[int, ...]:
        if isinstance(value, tuple):
            return value
        edges = value.split(",")
        if not all(is_whole(edge, 1, 4096) for edge in edges):
            self.fail(f"{value!r} is not a list of resolutions; allowed: R,R,..., each 1 to 4096", param, ctx)
        return tuple(dict.fromkeys(map(int, edges)))


class Names(ParamType[tuple[str, ...]]):
    """One or several names. allowed: the known names; none: any."""

    name = "NAME,..."

    def __init__(self, *allowed: str) -> None:
        self._allowed = allowed

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[str, ...]:
        if isinstance(value, tuple):
            return value
        names = tuple(dict.fromkeys(name.strip() for name in value.split(",") if name.strip()))
        for name in names:
            if self._allowed and name not in self._allowed:
                self.fail(f"{name!r} is not known; allowed: {', '.join(self._allowed)}", param, ctx)
        if self._allowed and not names:
            self.fail(f"there is no name; allowed: {', '.join(self._allowed)}", param, ctx)
        return names
