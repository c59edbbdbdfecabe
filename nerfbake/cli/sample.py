"""`nerfbake sample`: synthetic scenes for trying things out, without a download."""

from __future__ import annotations

import click

import nerfbake
from nerfbake import io
from nerfbake.cli.params import Output, speaks, writes
from nerfbake.cli.words import Words


@click.group()
def sample() -> None:
    """Write a synthetic scene, to try things out without a download."""


@sample.command()
@writes("N3Tree")
@click.option(
    "--resolution",
    type=click.IntRange(4, 1024),
    default=128,
    show_default=True,
    help="Cells along each axis, a power of two.",
)
@click.option(
    "--basis",
    type=click.Choice(["SH1", "SH4", "SH9", "SH16", "SH25"]),
    default="SH9",
    show_default=True,
    help="The spherical harmonics that hold the colours.",
)
@click.option(
    "--seed", type=click.IntRange(min=0), default=0, show_default=True, help="The same seed gives the same bytes."
)
@speaks
def octree(target: Output, resolution: int, basis: str, seed: int, words: Words) -> None:
    """Write a PlenOctree (svox .npz) of shiny shapes, with leaves at several depths, as OUT.

    \b
      nerfbake sample octree sample.npz --resolution 256
    """
    target.require("N3Tree")
    with words.phase("growing the tree"):
        tree = nerfbake.sample_n3tree(resolution=resolution, basis=basis, seed=seed)
    target.write(words, tree)


@sample.command()
@click.argument("target", metavar="OUT_DIR", type=click.Path())
@click.option("--resolution", type=int, default=512, show_default=True, help="Texels along each edge of the textures.")
@click.option(
    "--seed", type=click.IntRange(min=0), default=0, show_default=True, help="The same seed gives the same bytes."
)
@click.option("--force", is_flag=True, help="Replace OUT_DIR and everything in it.")
@speaks
def nerf2mesh(target: str, resolution: int, seed: int, force: bool, words: Words) -> None:
    """Write a nerf2mesh stage-1 folder of a glossy torus as OUT_DIR: mesh, textures, and an MLP fitted to its look.

    \b
      nerfbake sample nerf2mesh mesh_stage1 && nerfbake atlas mesh_stage1 atlas
    """
    io.require_no_folder(target, force=force)
    with words.phase("fitting the MLP"):
        scene = nerfbake.sample_stage1(resolution=resolution, seed=seed)
    sizes = io.save_folder(target, scene, force=force)
    words.say(f"{target}: {scene}, {sum(sizes.values()):,} bytes")
