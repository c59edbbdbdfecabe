"""Options of the world that cameras are put into."""

from __future__ import annotations

from collections.abc import Callable

import click

from nerfbake.cli.params import Command, bundled


def world_options(default: str) -> Callable[[Command], Command]:
    """Add --scale, whose default is this text, and --ground; pass the command `world`, a WorldOptions."""
    return bundled(
        "world",
        "jobs.world.WorldOptions",
        click.option(
            "--scale",
            metavar="gps|POINT,POINT=1.2m|none",
            help="Unit of the world. gps: metres, x east, y north, z up, by the positions in the photographs. "
            "POINT,POINT=1.2m: the distance between two points (m, cm or mm), each the NAME of a photograph, for its "
            f"place, or what two photographs show at a pixel, NAME:X:Y+NAME:X:Y.  [default: {default}]",
        ),
        click.option(
            "--ground",
            is_flag=True,
            help="Turn the world so that z points up and is 0 on the ground, the largest plane of sparse points below "
            "the cameras.",
        ),
    )
