"""What commands that read or write VDB grids share: which grids, how they stand, what a format holds."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import click

import nerfbake
from nerfbake import catalog
from nerfbake.cli.words import Words
from nerfbake.errors import UsageError
from nerfbake.jobs.files import Target
from nerfbake.jobs.grids import Choice

GRIDS = ("density", "Cd", "sh", "index")

codec_option = click.option(
    "--codec",
    type=click.Choice(["none", "zip"]),
    help="How a .vdb or .nvdb is compressed.  [default: zip for .vdb, none for .nvdb]",
)
Command = Callable[..., Any]


def chooses_grids(function: Command) -> Command:
    """Adds --grid and --up; the command gets `choice`."""

    @click.option(
        "--grid",
        "grids",
        multiple=True,
        metavar="NAME",
        help="Take only this grid of a volume: a name, or a number from 0.",
    )
    @click.option(
        "--up", type=click.Choice(["y", "z"]), help="The axis that points up in the volume; y is turned to z."
    )
    @functools.wraps(function)
    def command(*args: Any, grids: tuple[str, ...], up: str | None, **others: Any) -> Any:
        return function(*args, choice=Choice(grids, up), **others)

    return command


def is_volume(target: Target) -> bool:
    """Whether OUT is to be a volume."""
    return catalog.is_ending(target.path if target.to is None else f".{target.to.removeprefix('.')}", "Volume")


def require_grids(form: catalog.Format, grids: str | None, *, half: bool) -> tuple[str, ...]:
    """These grids, or those that the format has where nobody says which.

    Raises UsageError, before any work is done, for grids that it cannot hold.
    """
    module = form.load_volume_module()
    wanted = tuple(grids.split(",")) if grids else module.DEFAULT_GRIDS
    if not set(wanted) <= set(GRIDS) or len(set(wanted)) < len(wanted) or ("index" in wanted and len(wanted) > 1):
        raise UsageError(f"--grids are {','.join(wanted)!r}; allowed: some of density, Cd, sh, or index alone")
    module.require_grids(wanted, half=half)
    return wanted


def tell_of_halves(words: Words, form: catalog.Format, volume: nerfbake.Volume) -> None:
    """Says what other programs make of a density in halves."""
    note, first = form.load_volume_module().HALF_NOTE, volume.grids[0]
    if note and isinstance(first, nerfbake.VdbTree) and first.values.dtype == "float16":
        words.say(note)
