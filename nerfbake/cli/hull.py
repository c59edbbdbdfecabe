"""`nerfbake hull`: a mesh around what can be seen."""

from __future__ import annotations

from typing import Any

import click

from nerfbake.cli.params import reads, speaks, writes
from nerfbake.cli.words import Words
from nerfbake.jobs.files import Source, Target
from nerfbake.jobs.hulls import LEVEL, bake_hull


@click.command()
@reads
@writes("Meshes")
@click.option(
    "--level",
    type=click.IntRange(0, 12),
    default=LEVEL,
    show_default=True,
    help="How fine: 2^LEVEL boxes along the longest edge of what can be seen, but none smaller than a voxel.",
)
@click.option(
    "--up",
    type=click.Choice(["y", "z"]),
    help="The axis that points up in IN. z: the nodes of a .glb turn it to y.  [default: nothing is turned]",
)
@speaks
def hull(source: Source, target: Target, words: Words, **options: Any) -> None:
    """Make a tight mesh around a scene, for engines.

    Writes OUT, a mesh of boxes around everything that can be seen of the PlenOctree, octree or volume IN. An engine
    draws it, and marches the field's rays inside it.

    \b
      nerfbake hull chair.npz hull.glb
      nerfbake hull chair.svo.pb hull.obj --level 6
      nerfbake hull smoke.vdb hull.glb --up z
    """
    bake_hull(source, target, steps=words, **options)
