"""The options that commands which read or write VDB grids share."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import click

from nerfbake.jobs.grids import Choice

codec_option = click.option(
    "--codec",
    type=click.Choice(["none", "zip"]),
    help="How a .vdb or .nvdb is compressed.  [default: zip for .vdb, none for .nvdb]",
)
Command = Callable[..., Any]
ALL = "all"


def chooses_grids(function: Command) -> Command:
    """Adds --grid and --up; the command gets `choice`."""

    @click.option(
        "--grid",
        "grids",
        multiple=True,
        metavar="NAME",
        help="Take only this grid of a volume: a name, or a number from 0; for `convert` also all, a file for each.",
    )
    @click.option(
        "--up", type=click.Choice(["y", "z"]), help="The axis that points up in the volume; y is turned to z."
    )
    @functools.wraps(function)
    def command(*args: Any, grids: tuple[str, ...], up: str | None, **others: Any) -> Any:
        return function(*args, choice=Choice(grids, up), **others)

    return command
