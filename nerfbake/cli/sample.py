"""`nerfbake sample`: synthetic scenes for trying things out, without a download."""

from __future__ import annotations

from typing import Any

import click

from nerfbake.cli.params import max_memory, seed, sh_basis, speaks, writes
from nerfbake.cli.paths import Writes
from nerfbake.cli.words import Words
from nerfbake.jobs.files import FolderTarget, Target
from nerfbake.jobs.samples import write_sample_capture, write_sample_n3tree, write_sample_stage1


@click.group()
def sample() -> None:
    """Write a synthetic scene to try things with."""


@sample.command()
@writes("N3Tree")
@click.option(
    "--resolution",
    type=click.IntRange(4, 1024),
    default=128,
    show_default=True,
    help="Cells along each axis, a power of two.",
)
@sh_basis
@seed
@max_memory
@speaks
def octree(target: Target, words: Words, **options: Any) -> None:
    """Write a PlenOctree of shiny shapes.

    OUT is a svox .npz with leaves at several depths.

    \b
      nerfbake sample octree sample.npz --resolution 256
    """
    write_sample_n3tree(target, steps=words, **options)


@sample.command()
@click.argument("target", metavar="OUT_DIR", type=Writes())
@click.option("--resolution", type=int, default=512, show_default=True, help="Texels along each edge of the textures.")
@seed
@click.option("--force", is_flag=True, help="Replace OUT_DIR and everything in it.")
@max_memory
@speaks
def nerf2mesh(target: str, force: bool, words: Words, **options: Any) -> None:
    """Write a nerf2mesh folder of a glossy torus.

    OUT_DIR holds a mesh, textures, and an MLP that is fitted to the highlights.

    \b
      nerfbake sample nerf2mesh mesh_stage1 && nerfbake atlas mesh_stage1 atlas
    """
    write_sample_stage1(FolderTarget(target, force), steps=words, **options)


@sample.command()
@click.argument("target", metavar="OUT_DIR", type=Writes())
@click.option("--frames", type=click.IntRange(2, 1000), default=24, show_default=True, help="How many photographs.")
@click.option("--edge", type=click.IntRange(16, 4096), default=200, show_default=True, help="Their edge in pixels.")
@seed
@click.option("--force", is_flag=True, help="Replace files in OUT_DIR that have the same names.")
@max_memory
@speaks
def capture(target: str, words: Words, **options: Any) -> None:
    """Write photographs of shiny shapes with cameras.

    OUT_DIR holds pictures from all sides, and their cameras as transforms.json.

    \b
      nerfbake sample capture photographs && nerfbake info photographs
    """
    write_sample_capture(target, steps=words, **options)
