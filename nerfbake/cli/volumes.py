"""What commands that read or write VDB grids share: which grids, how they stand, what a format holds."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import click

from nerfbake import catalog, io
from nerfbake.errors import UsageError
from nerfbake.jobs.files import Target
from nerfbake.jobs.grids import Choice

GRIDS = ("density", "Cd", "sh", "index")
DEFAULT_CODEC = {"vdb": "zip", "nvdb": "none"}  # .vdb.npz has none

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


def form_of(target: Target) -> str:
    """vdb, nvdb or vdb.npz."""
    return io.uncompressed(io.format_for(target.path, "Volume", to=target.to).name)


def codec_for(form: str, codec: str | None) -> dict[str, str]:
    """What encode() takes. Raises UsageError where the format has no codecs."""
    if form in DEFAULT_CODEC:
        return {"codec": codec or DEFAULT_CODEC[form]}
    if codec:
        raise UsageError(f"a .{form} has no codecs; allowed: no --codec, .{form}.zst")
    return {}


def require_grids(form: str, grids: tuple[str, ...], *, half: bool) -> None:
    """Raises UsageError, before any work is done, for grids that this format does not hold."""
    if not set(grids) <= set(GRIDS) or len(set(grids)) < len(grids) or ("index" in grids and len(grids) > 1):
        raise UsageError(f"--grids are {','.join(grids)!r}; allowed: some of density, Cd, sh, or index alone")
    if form == "vdb" and "index" in grids:
        raise UsageError("a .vdb has no index grids; allowed: density, Cd, sh; or a .nvdb, a .vdb.npz")
    if form == "nvdb" and (len(grids) > 1 or "sh" in grids):
        raise UsageError(f"a .nvdb would hold the grids {','.join(grids)}; allowed: one of density, Cd, index")
    if form == "nvdb" and half and "Cd" in grids:
        raise UsageError("a .nvdb has no half colours; allowed: no --half, or another grid")


WARP_NOTE = "note: half densities in a .nvdb are Fp16, which Warp loads and then reads as zeros"
