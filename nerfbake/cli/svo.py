"""`nerfbake svo`: PlenOctree to sparse voxel octree, as TR-24-01 has it (docs/sources.md)."""

from __future__ import annotations

from typing import Any

import click

from nerfbake.cli.params import NumberRange, Resolution, judges, reads, speaks, writes_octree
from nerfbake.cli.words import Words
from nerfbake.jobs.files import Source, Target
from nerfbake.jobs.octrees import bake_octree

RESAMPLE = "What a voxel over several leaves holds: their mean, or the leaf at its centre (as in the report TR-24-01)."


@click.command()
@reads
@writes_octree()
@click.option(
    "--resolution",
    type=Resolution(),
    help="Voxels along each axis, 1 to 4096.  [default: the tree's finest; twice a lattice's]",
)
@click.option("--resample", type=click.Choice(["mean", "nearest"]), default="mean", show_default=True, help=RESAMPLE)
@click.option(
    "--layout",
    type=click.Choice(["full", "compact"]),
    default="full",
    show_default=True,
    help="full: child slots for every node; compact: none for the nodes of the last level.",
)
@click.option(
    "--dtype",
    type=click.Choice(["float32", "float16"]),
    default="float32",
    show_default=True,
    help="The number type of the values that OUT stores.",
)
@click.option("--sigma-min", type=NumberRange(min=0), help="Treat leaves of less density (1/world unit) as empty.")
@click.option(
    "--basis",
    type=click.Choice(["SH1", "SH4", "SH9", "SH16", "SH25"]),
    help="Of a lattice: the spherical harmonics that hold the colours.  [default: SH9]",
)
@click.option(
    "--scale",
    type=NumberRange(1e-6, 1e6),
    help="Scale factor for world coordinates (lattices only).",
)
@judges
@speaks
def svo(source: Source, target: Target, words: Words, **options: Any) -> None:
    """Convert a PlenOctree or lattice to an octree.

    Resamples IN, a PlenOctree or the lattice of another program, to the sparse voxel octree OUT.

    \b
      nerfbake svo chair.npz chair.svo.pb --resolution 128
      nerfbake svo ckpt.npz chair.svo.pb --basis SH16 --min-psnr 40
      nerfbake svo chair.npz small.svo.npz --resolution 100x80x60 --layout compact --dtype float16
    """
    bake_octree(source, target, steps=words, **options)
