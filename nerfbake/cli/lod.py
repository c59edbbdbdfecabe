"""`nerfbake lod`: an octree cut at a level."""

from __future__ import annotations

from typing import Any

import click

from nerfbake.cli.params import judges, reads, speaks, writes_octree
from nerfbake.cli.words import Words
from nerfbake.jobs.files import Source, Target
from nerfbake.jobs.octrees import bake_lod


@click.command()
@reads
@writes_octree()
@click.option(
    "--level", type=click.IntRange(min=0), required=True, help="The deepest level to keep; 0 is the root alone."
)
@judges
@speaks
def lod(source: Source, target: Target, words: Words, **options: Any) -> None:
    """Cut an octree at a coarser level of detail.

    Writes the levels of IN down to --level as OUT. A node there has the mean of what was below it.

    \b
      nerfbake lod chair.svo.pb chair_lod.svo.pb --level 6
    """
    bake_lod(source, target, steps=words, **options)
