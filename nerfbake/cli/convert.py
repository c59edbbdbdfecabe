"""`nerfbake convert`: the same octree in another format or layout."""

from __future__ import annotations

from typing import Literal

import click

import nerfbake
from nerfbake.cli.params import Input, Output, reads, speaks, writes_octree
from nerfbake.cli.words import Words


@click.command()
@reads
@writes_octree
@click.option(
    "--layout",
    type=click.Choice(["full", "compact"]),
    help="Child slots for every node, or only above the last level.  [default: as in IN]",
)
@speaks
def convert(
    source: Input, target: Output, layout: Literal["full", "compact"] | None, no_child: int, words: Words
) -> None:
    """Write the octree IN as OUT, in another format or layout, without loss.

    IN may also be what `nerfbake vdb` wrote with the grids `index` or `density,sh`.

    \b
      nerfbake convert chair.svo.pb chair.svo.npz
      nerfbake convert chair.svo.pb - --to svo.npz --layout compact > chair.svo.npz
      nerfbake convert chair.nvdb chair.svo.pb
    """
    target.require("SparseVoxelOctree")
    octree = source.read(words, nerfbake.SparseVoxelOctree, nerfbake.Volume)
    if isinstance(octree, nerfbake.Volume):
        with source.blamed(words, "restoring the octree"):
            octree = nerfbake.restore_octree(octree)
    target.write(words, octree.with_layout(layout or octree.layout), no_child=no_child)
