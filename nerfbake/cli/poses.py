"""`nerfbake poses`: find the camera poses of photographs."""

from __future__ import annotations

from typing import Any

import click

from nerfbake import io
from nerfbake.cli.params import as_json, console_options, max_memory
from nerfbake.cli.paths import PhotographsWithPoses
from nerfbake.cli.world_params import world_options
from nerfbake.console import Console


@click.command()
@click.argument("source", metavar="PHOTOS", type=PhotographsWithPoses())
@click.option(
    "--sequential",
    is_flag=True,
    default=None,
    help="Match each picture only with the next ones, in the order of names: for frames of a video.  [default: if there"
    " are more than 150 pictures]",
)
@click.option(
    "--panoramas",
    is_flag=True,
    help="Pictures twice as wide as high show all directions, even if they do not say so.",
)
@click.option(
    "--seed",
    type=click.IntRange(0, 2**31 - 1),
    default=0,
    show_default=True,
    help="Random seed. On one machine, the same seed gives the same poses.",
)
@world_options("gps if the photographs have positions that fit, else none")
@click.option("--force", is_flag=True, help="Replace transforms.json and sparse/0 in PHOTOS.")
@max_memory
@as_json
@console_options
def poses(source: str, as_json: bool, console: Console, **options: Any) -> None:
    """Find the camera poses of photographs.

    Reads the pictures in the folder PHOTOS or in its subfolder images. Writes their poses to PHOTOS: transforms.json,
    and a COLMAP model in sparse/0. Needs pycolmap, which the extra `poses` installs.

    \b
      nerfbake poses photographs && nerfbake fit photographs scene.npz
      nerfbake poses frames --sequential --json
      nerfbake poses theta --panoramas
      nerfbake poses photographs --scale IMG_1,IMG_5=1.2m --ground
    """

    from nerfbake.jobs.poses import find_poses

    found = find_poses(source, steps=console, **options)
    if as_json:
        io.print_json(found._asdict())
