"""Options for files of splats."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import click

from nerfbake.cli.params import ParamType, bundled

if TYPE_CHECKING:
    from nerfbake.scene.splats import Axes


class AxesName(ParamType["Axes"]):
    """Where x, y and z point: RUB is right, up, back."""

    name = "AXES"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Axes:
        from nerfbake.scene.splat_axes import AXES

        found = next((axes for axes in AXES if axes == str(value).upper()), None)
        if found is None:
            self.fail(f"{str(value)[:40]!r} are no axes of splats; allowed: {', '.join(AXES)}", param, ctx)
        return found


splat_file_options = bundled(
    "splats",
    "jobs.splat_choice.SplatChoice",
    click.option(
        "--in-axes",
        type=AxesName(),
        help="Axes of splats in IN, instead of those that it names: where x, y and z point (Left or Right, Up or Down,"
        " Front or Back).  [default: RUB in a .spz that names none, LUF in glTF]",
    ),
    click.option("--axes", type=AxesName(), help="Axes of a .spz as OUT, which stores their name.  [default: RUB]"),
    click.option(
        "--spz-version",
        type=click.Choice(["3", "4"]),
        callback=lambda ctx, param, value: value and int(value),
        help="Version of a .spz as OUT. 3: for older programs.  [default: 4]",
    ),
    click.option("--small", is_flag=True, help="Store the SH of a .spz in 4 and 5 bits instead of 8."),
    without=("half",),  # of `convert`, which is for volumes, too
)
