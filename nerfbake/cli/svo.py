"""`nerfbake svo`: convert a field or splats to a sparse voxel octree, after TR-24-01 (docs/sources.md)."""

from __future__ import annotations

from typing import Any

import click

from nerfbake.cli.function_params import function_options
from nerfbake.cli.params import (
    NumberRange,
    PartBox,
    Resolution,
    budget_options,
    console_options,
    octree_target_argument,
    reading_options,
    sh_bases,
    sigma_min,
    source_argument,
)
from nerfbake.console import Console
from nerfbake.jobs.files import Source, Target

RESAMPLE = (
    "Value of a voxel that covers several leaves. mean: their mean; nearest: the leaf at its centre, as in the report "
    "TR-24-01."
)


@click.command()
@source_argument
@octree_target_argument()
@click.option(
    "--resolution",
    type=Resolution(),
    help="Voxels along each axis, 1 to 4096; of splats along the longest.  [default: the finest of a tree; twice that "
    "of a lattice; 256, fewer if splats are large or do not fit into memory]",
)
@click.option("--resample", type=click.Choice(["mean", "nearest"]), default="mean", show_default=True, help=RESAMPLE)
@click.option(
    "--layout",
    type=click.Choice(["full", "compact"]),
    default="full",
    show_default=True,
    help="full: child slots for every node; compact: no child slots on the last level.",
)
@click.option(
    "--dtype",
    type=click.Choice(["float32", "float16"]),
    default="float32",
    show_default=True,
    help="Number type of the values in OUT.",
)
@sigma_min
@reading_options(
    click.option(
        "--box",
        type=PartBox(),
        default="inner",
        show_default=True,
        help="Part of the scene. inner: without scenery and distant splats. all: the whole scene. X0,...,Z1: two "
        "opposite corners of a box, in world coordinates of OUT (splats only).",
    ),
    click.option(
        "--basis",
        type=sh_bases,
        help="Spherical-harmonics basis of the colours (lattices and splats only).  [default: SH9; that of the splats]",
    ),
    click.option(
        "--scale",
        type=NumberRange(1e-6, 1e6),
        help="Scale factor for world coordinates (lattices only).",
    ),
    in_up=None,
)
@function_options("resolution", "box", "basis")
@budget_options
@console_options
def svo(source: Source, target: Target, console: Console, **options: Any) -> None:
    """Convert a field or splats to an octree.

    Resamples IN, a PlenOctree, a lattice from another program or Gaussian splats, to the sparse voxel octree OUT. An
    octree or a volume keeps its voxels. Voxels of splats are fitted to pictures of the splats from all sides.

    \b
      nerfbake svo chair.npz chair.svo.pb --resolution 128
      nerfbake svo ckpt.npz chair.svo.pb --basis SH16 --min-psnr 40
      nerfbake svo phone.npz phone.svo.pb --box all
      nerfbake svo scene.ply scene.svo.pb --resolution 512 --box=-1,-1,-1,1,1,1 --in-up=-y
      nerfbake svo chair.npz small.svo.npz --resolution 100x80x60 --layout compact --dtype float16
    """

    from nerfbake.jobs.octrees import bake_octree

    bake_octree(source, target, steps=console, **options)
