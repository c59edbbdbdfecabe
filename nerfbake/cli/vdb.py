"""`nerfbake vdb`: PlenOctree or octree to OpenVDB or NanoVDB."""

from __future__ import annotations

from typing import Any

import click

from nerfbake.cli.params import NumberRange, Resolution, judges, reads, speaks, writes
from nerfbake.cli.volumes import codec_option
from nerfbake.cli.words import Words
from nerfbake.jobs.files import Source, Target
from nerfbake.jobs.volumes import bake_volume

GRIDS = "Some of density, Cd (the mean colour over all directions), sh (SH coefficients); or index (all in one table)."


@click.command()
@reads
@writes("Volume")
@click.option("--grids", help=f"{GRIDS}  [default: density,Cd, but density for .nvdb]")
@click.option("--half", is_flag=True, help="Store values as float16.")
@codec_option
@click.option(
    "--resolution",
    type=Resolution(),
    help="Voxels along each axis of a PlenOctree.  [default: its finest; twice a lattice's]",
)
@click.option("--sigma-min", type=NumberRange(min=0), help="Treat leaves of less density (1/world unit) as empty.")
@click.option(
    "--up",
    type=click.Choice(["y", "z"]),
    default="z",
    show_default=True,
    help="The axis that points up in OUT; in IN it is z.",
)
@judges
@speaks
def vdb(source: Source, target: Target, words: Words, **options: Any) -> None:
    """Convert a PlenOctree or octree to a VDB volume.

    OUT is OpenVDB (.vdb), NanoVDB (.nvdb, one grid a file) or plain arrays (.vdb.npz).

    \b
      nerfbake vdb chair.npz chair.vdb
      nerfbake vdb chair.svo.pb chair.nvdb --grids index --half
      nerfbake vdb chair.npz - --to nvdb | nerfbake info -
    """
    bake_volume(source, target, steps=words, **options)
