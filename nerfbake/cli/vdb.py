"""`nerfbake vdb`: convert a field or splats to OpenVDB or NanoVDB."""

from __future__ import annotations

from typing import Any

import click

from nerfbake.cli.function_params import function_options
from nerfbake.cli.params import (
    PartBox,
    Resolution,
    budget_options,
    codec_option,
    console_options,
    reading_options,
    sigma_min,
    source_argument,
    target_argument,
)
from nerfbake.cli.paths import MeshOutput
from nerfbake.console import Console
from nerfbake.jobs.files import Source, Target

GRIDS = (
    "Grids to write, separated by commas: density, Cd (mean colour over all directions), sh (SH coefficients); or "
    "index (all values in one table)."
)


@click.command()
@source_argument
@target_argument("Volume", output=MeshOutput)
@click.option("--grids", help=f"{GRIDS}  [default: density,Cd; density for .nvdb]")
@click.option("--half", is_flag=True, help="Store values as float16.")
@codec_option
@click.option(
    "--resolution",
    type=Resolution(),
    help="Voxels along each axis of a PlenOctree.  [default: its finest; twice that of a lattice; 256 along the longest"
    " axis of splats, fewer if these are large or do not fit into memory]",
)
@sigma_min
@click.option(
    "--up",
    type=click.Choice(["y", "z"]),
    default="z",
    show_default=True,
    help="Up axis of OUT. The up axis of IN is z; of splats that of --in-up.",
)
@reading_options(
    click.option(
        "--box",
        type=PartBox(),
        default="inner",
        show_default=True,
        help="Part of splats: those that are not far outside, all of them, or those between two opposite corners of a "
        "box in the world of OUT with z up (splats only).",
    ),
    in_up="stated",
)
@function_options("resolution", "box")
@budget_options
@console_options
def vdb(source: Source, target: Target, console: Console, **options: Any) -> None:
    """Convert a field or splats to a VDB volume.

    Writes OUT as OpenVDB (.vdb), NanoVDB (.nvdb, one grid per file) or plain arrays (.vdb.npz), or as a stage of USD
    (.usda, .usdc) with a .vdb of the same name beside it.

    \b
      nerfbake vdb chair.npz chair.vdb
      nerfbake vdb chair.svo.pb chair.nvdb --grids index --half
      nerfbake vdb scene.spz scene.vdb --resolution 512
      nerfbake vdb chair.npz chair.usda
      nerfbake vdb chair.npz - --to nvdb | nerfbake info -
    """

    from nerfbake.jobs.octrees import bake_volume

    bake_volume(source, target, steps=console, **options)
