"""`nerfbake lattice`: a PlenOctree or an octree as other programs would have trained it."""

from __future__ import annotations

from typing import Any

import click

from nerfbake.cli.params import NumberRange, Resolution, judges, reads, seed, speaks
from nerfbake.cli.paths import Output
from nerfbake.cli.words import Words
from nerfbake.jobs.files import FolderTarget, Source
from nerfbake.jobs.lattices import FINEST, bake_lattice


@click.command()
@reads
@click.argument("target", metavar="OUT_DIR", type=Output())
@click.option("--force", is_flag=True, help="Replace OUT_DIR and everything in it.")
@click.option(
    "--resolution",
    type=Resolution(),
    help=f"Voxels along each axis of a PlenOctree, 1 to 4096.  [default: its finest, but {FINEST} at most]",
)
@click.option("--sigma-min", type=NumberRange(min=0), help="Treat leaves of less density (1/world unit) as empty.")
@click.option(
    "--rounds",
    type=click.IntRange(1, 100_000),
    default=3000,
    show_default=True,
    help="How long the MLP is fitted: rounds of 2,048 colours each, about 100 a second on two cores.",
)
@click.option("--merged", is_flag=True, help="Store the values once, as rows of float16, for occupied nodes alone.")
@seed
@judges
@speaks
def lattice(source: Source, target: str, force: bool, words: Words, **options: Any) -> None:
    """Convert a PlenOctree or octree to PlenVDB's folder.

    OUT_DIR holds a lattice with an MLP, as PlenVDB trains and shows it.

    \b
      nerfbake lattice chair.npz chair_plenvdb
      nerfbake lattice chair.svo.pb chair_plenvdb --merged --min-psnr 30
    """
    bake_lattice(source, FolderTarget(target, force), steps=words, **options)
