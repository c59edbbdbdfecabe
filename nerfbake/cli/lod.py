"""`nerfbake lod`: an octree cut at a level."""

from __future__ import annotations

import click

import nerfbake
from nerfbake.cli.params import Budget, Input, Output, judges, reads, speaks, writes_octree
from nerfbake.cli.words import Words


@click.command()
@reads
@writes_octree()
@click.option(
    "--level", type=click.IntRange(min=0), required=True, help="The deepest level to keep; 0 is the root alone."
)
@judges
@speaks
def lod(source: Input, target: Output, level: int, no_child: int, budget: Budget, words: Words) -> None:
    """Write the octree IN down to a level as OUT; what is cut off is shown by its mean.

    \b
      nerfbake lod chair.svo.pb chair_lod.svo.pb --level 6
    """
    target.require("SparseVoxelOctree")
    budget.require(target)
    octree = source.read(words, nerfbake.SparseVoxelOctree)
    with source.blamed(words, f"cutting at level {level}"):
        cut = nerfbake.cut_octree(octree, level=level)
    target.write(words, cut, no_child=no_child)
    budget.judge(words, source, octree, target)
