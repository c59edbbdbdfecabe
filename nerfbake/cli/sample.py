"""`nerfbake sample`: write synthetic scenes to try nerfbake with, without a download."""

from __future__ import annotations

from typing import Any

import click

from nerfbake.cli.params import console_options, folder_argument, max_memory, seed, sh_bases, target_argument
from nerfbake.cli.paths import Writes
from nerfbake.console import Console
from nerfbake.jobs.files import FolderTarget, Target


@click.group()
def sample() -> None:
    """Write a synthetic scene to try nerfbake with."""


@sample.command()
@target_argument("N3Tree")
@click.option(
    "--resolution",
    type=click.IntRange(4, 1024),
    default=128,
    show_default=True,
    help="Cells along each axis: a power of two.",
)
@click.option(
    "--basis", type=sh_bases, default="SH9", show_default=True, help="Spherical-harmonics basis of the colours."
)
@seed
@max_memory
@console_options
def octree(target: Target, console: Console, **options: Any) -> None:
    """Write a PlenOctree of shiny shapes.

    Writes OUT, a PlenOctree as svox stores it (.npz), with leaves at several depths.

    \b
      nerfbake sample octree sample.npz --resolution 256
    """

    from nerfbake.jobs.samples import write_sample_n3tree

    write_sample_n3tree(target, steps=console, **options)


@sample.command()
@folder_argument()
@click.option("--resolution", type=int, default=512, show_default=True, help="Texels along each edge of the textures.")
@seed
@max_memory
@console_options
def nerf2mesh(target: FolderTarget, console: Console, **options: Any) -> None:
    """Write a nerf2mesh folder of a glossy torus.

    Writes OUT_DIR with a mesh, textures, and an MLP that is fitted to the highlights.

    \b
      nerfbake sample nerf2mesh mesh_stage1 && nerfbake atlas mesh_stage1 atlas
    """

    from nerfbake.jobs.samples import write_sample_stage1

    write_sample_stage1(target, steps=console, **options)


@sample.command()
@click.argument("target", metavar="OUT_DIR", type=Writes())
@click.option("--frames", type=click.IntRange(2, 1000), default=24, show_default=True, help="Number of photographs.")
@click.option(
    "--edge", type=click.IntRange(16, 4096), default=200, show_default=True, help="Width and height in pixels."
)
@click.option("--room", is_flag=True, help="Photograph a table in a textured room, with scenery on all sides.")
@click.option(
    "--object",
    type=click.Choice(["shapes", "struts", "bricks"]),
    default="shapes",
    show_default=True,
    help="Photograph shiny shapes, a crane of thin rods, or a glossy house of bricks with thousands of studs.",
)
@seed
@click.option("--force", is_flag=True, help="Replace files in OUT_DIR that have the same names.")
@max_memory
@console_options
def capture(target: str, console: Console, **options: Any) -> None:
    """Write synthetic photographs with cameras.

    Writes OUT_DIR with pictures of shiny shapes from all sides, and their cameras in transforms.json. The other objects
    are seen from above, and are harder to fit. With --room, the pictures show a table in a room, as photographs from a
    phone do.

    \b
      nerfbake sample capture photographs && nerfbake info photographs
      nerfbake sample capture --room room && nerfbake fit room room.npz
      nerfbake sample capture --object bricks --frames 100 --edge 400 house
    """

    from nerfbake.jobs.samples import write_sample_capture

    write_sample_capture(target, steps=console, **options)
