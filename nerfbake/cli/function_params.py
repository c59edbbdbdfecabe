"""Options that say how a field of another program's network becomes voxels."""

from __future__ import annotations

from collections.abc import Callable

import click

from nerfbake.cli.params import CAPTURE, Box, Command, ParamType, bundled, is_whole, sh_bases
from nerfbake.cli.paths import Capture


class CellCount(ParamType[int]):
    """Cells along an edge, a power of two from 8 to 4096."""

    name = "R"

    def convert(self, value: object, param: click.Parameter | None, ctx: click.Context | None) -> int:
        word = str(value)
        if not is_whole(word, 8, 4096) or int(word) & (int(word) - 1):
            self.fail(f"{value!r} is not a number of cells; allowed: a power of two, 8 to 4096", param, ctx)
        return int(word)


world_option = click.option(
    "--world",
    type=click.Choice(["original", "trained"]),
    default="original",
    show_default=True,
    help="World coordinates of a trained field: those of your own cameras, or those of the network.",
)
_OPTIONS = {
    "resolution": click.option(
        "--resolution",
        type=CellCount(),
        help="Cells along each edge of a baked field (trained fields only).  [default: 256]",
    ),
    "box": click.option(
        "--box",
        type=Box(),
        help="Two opposite corners of what is baked of a trained field.  [default: what the cameras see]",
    ),
    "basis": click.option(
        "--basis",
        type=sh_bases,
        help="Spherical-harmonics basis of a trained field's colours.  [default: SH9, or that of the network]",
    ),
    "scenery": click.option(
        "--scenery/--no-scenery",
        default=None,
        help="Also bake what is around a trained field's object.  [default: if more than 5 % of the light comes from "
        "there]",
    ),
    "world": world_option,
    "seen_from": click.option(
        "--seen-from",
        metavar="CAPTURE",
        type=Capture(),
        help=f"Cameras that a trained field is baked for: {CAPTURE}.  [default: those that it was trained with]",
    ),
}


def function_options(*without: str) -> Callable[[Command], Command]:
    """Add the options of trained fields, without these; pass the command `functions`, a FunctionVoxels."""
    chosen = [option for name, option in _OPTIONS.items() if name not in without]
    return bundled("functions", "jobs.function_voxels.FunctionVoxels", *chosen, without=without)
