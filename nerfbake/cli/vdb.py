"""`nerfbake vdb`: PlenOctree or octree to OpenVDB or NanoVDB."""

from __future__ import annotations

from typing import Any, Literal

import click

import nerfbake
from nerfbake.cli.params import Resolution, judges, reads, speaks, writes
from nerfbake.cli.volumes import codec_option, require_grids, tell_of_halves
from nerfbake.cli.words import Words
from nerfbake.errors import UsageError
from nerfbake.jobs.budgets import Budget, judge
from nerfbake.jobs.files import Source, Target

GRIDS = "Some of density, Cd (the mean colour over all directions), sh (SH coefficients); or index (all in one table)."


@click.command()
@reads
@writes("Volume")
@click.option("--grids", help=f"{GRIDS}  [default: density,Cd, but density for .nvdb]")
@click.option("--half", is_flag=True, help="Store values as float16.")
@codec_option
@click.option("--resolution", type=Resolution(), help="Voxels along each axis of a PlenOctree.  [default: its finest]")
@click.option("--sigma-min", type=click.FloatRange(min=0), help="Treat leaves of less density (1/world unit) as empty.")
@click.option(
    "--up",
    type=click.Choice(["y", "z"]),
    default="z",
    show_default=True,
    help="The axis that points up in OUT; in IN it is z.",
)
@judges
@speaks
def vdb(
    source: Source,
    target: Target,
    grids: str | None,
    half: bool,
    codec: str | None,
    resolution: tuple[int, int, int] | None,
    sigma_min: float | None,
    up: Literal["y", "z"],
    budget: Budget,
    words: Words,
) -> None:
    """Write the PlenOctree or octree IN as OpenVDB (.vdb), NanoVDB (.nvdb, one grid a file) or arrays (.vdb.npz).

    \b
      nerfbake vdb chair.npz chair.vdb
      nerfbake vdb chair.svo.pb chair.nvdb --grids index --half
      nerfbake vdb chair.npz - --to nvdb | nerfbake info -
    """
    form = target.require("Volume", codec=codec)
    budget.require(target)
    wanted = require_grids(form, grids, half=half)
    scene: Any = source.read(words, nerfbake.N3Tree, nerfbake.SparseVoxelOctree)
    judged = None if budget.min_psnr is None else scene  # the tree goes as soon as nobody needs it
    options: Any = {"sigma_min": sigma_min}
    with source.blamed(words, "building the grids"):
        if isinstance(scene, nerfbake.N3Tree):
            scene = nerfbake.build_octree(scene, resolution=resolution, **options)
        elif resolution:
            raise UsageError("an octree has its own resolution; allowed: --resolution with a PlenOctree")
        volume = nerfbake.build_vdb(scene, grids=wanted, half=half, up=up, **options)
    tell_of_halves(words, form, volume)
    target.write(words, volume, codec=codec)
    judge(target.path, judged, budget, made_from=source.name, up=up, steps=words)
