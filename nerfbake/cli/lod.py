"""`nerfbake lod`: an octree cut at a level."""

from __future__ import annotations

import click

import nerfbake
from nerfbake.cli.params import Input, Output, reads, speaks, writes_octree
from nerfbake.cli.words import Words


@click.command()
@reads
@writes_octree
@click.option("--level", type=click.IntRange(min=0), required=True, help="Deepest level to keep; 0 is the root alone.")
@speaks
def lod(source: Input, target: Output, level: int, no_child: int, words: Words) -> None:
    """Write the octree IN down to a level as OUT; what is cut off shows as its mean.

    \b
      nerfbake lod chair.svo.pb chair_lod.svo.pb --level 6
    """
    target.require("SparseVoxelOctree")
    octree = source.read(words, nerfbake.SparseVoxelOctree)
    with source.blamed(words, f"cutting at level {level}"):
        octree = nerfbake.cut_octree(octree, level=level)
    target.write(words, octree, no_child=no_child)
