"""`nerfbake lattice`: convert a field or splats to a PlenVDB folder, a lattice with an MLP."""

from __future__ import annotations

from typing import Any

import click

from nerfbake.cli.function_params import function_options
from nerfbake.cli.params import (
    Resolution,
    budget_options,
    console_options,
    folder_argument,
    seed,
    sigma_min,
    source_argument,
)
from nerfbake.cli.paths import JudgedOutput
from nerfbake.console import Console
from nerfbake.jobs.files import FolderTarget, Source


@click.command()
@source_argument
@folder_argument(JudgedOutput)
@click.option(
    "--resolution",
    type=Resolution(),
    help="Voxels along each axis of a PlenOctree, 1 to 4096.  [default: its finest, at most 256]",
)
@sigma_min
@click.option(
    "--rounds",
    type=click.IntRange(1, 100_000),
    default=3000,
    show_default=True,
    help="Rounds of fitting the MLP, each with 2,048 colours: about 100 rounds per second on two cores.",
)
@click.option("--merged", is_flag=True, help="Store values once, as rows of float16, for occupied nodes only.")
@seed
@function_options("resolution")
@budget_options
@console_options
def lattice(source: Source, target: FolderTarget, console: Console, **options: Any) -> None:
    """Convert a field or splats to a PlenVDB folder.

    Writes OUT_DIR, a lattice with an MLP in the layout that PlenVDB trains and renders.

    \b
      nerfbake lattice chair.npz chair_plenvdb
      nerfbake lattice chair.svo.pb chair_plenvdb --merged --min-psnr 30
    """

    from nerfbake.jobs.lattices import bake_lattice

    bake_lattice(source, target, steps=console, **options)
