"""`nerfbake convert`: the same octree, or the same volume, in another format or layout."""

from __future__ import annotations

from typing import Any

import click

from nerfbake.cli.params import reads, speaks, without_effect, writes_octree
from nerfbake.cli.volumes import ALL, chooses_grids, codec_option
from nerfbake.cli.words import Words
from nerfbake.jobs.conversions import convert_file, split_volume
from nerfbake.jobs.files import Source, Target


@click.command()
@reads
@writes_octree("Volume")
@click.option(
    "--layout",
    type=click.Choice(["full", "compact"]),
    help="full: child slots for every node; compact: none for the nodes of the last level.  [default: as in IN]",
)
@chooses_grids
@codec_option
@click.option("--half", is_flag=True, help="Store the values of a volume as float16.")
@speaks
def convert(source: Source, target: Target, words: Words, **options: Any) -> None:
    """Convert between formats without loss.

    Writes the octree IN in another format or layout, or the volume IN as .vdb, .nvdb or .vdb.npz.

    A volume becomes an octree where `nerfbake vdb` wrote it with the grids `index` or `density,sh`; of any other fog
    the octree has the density alone. With --grid all each grid of a volume becomes a file: smoke.density.nvdb, ...

    \b
      nerfbake convert chair.svo.pb chair.svo.npz
      nerfbake convert chair.svo.pb - --to svo.npz --layout compact > chair.svo.npz
      nerfbake convert chair.nvdb chair.svo.pb
      nerfbake convert smoke.vdb smoke.nvdb --grid density
      nerfbake convert smoke.vdb smoke.nvdb --grid all
      nerfbake convert smoke.vdb smoke.svo.npz --grid density --up y
    """
    if options["choice"].grids != (ALL,):
        convert_file(source, target, steps=words, **options)
        return
    for name in ("layout", "no_child"):
        without_effect(name, here="where each grid is written as a volume", allowed="no --grid all")
    split_volume(source, target, up=options["choice"].up, codec=options["codec"], half=options["half"], steps=words)
