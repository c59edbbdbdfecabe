"""`nerfbake lod`: cut an octree at a level."""

from __future__ import annotations

from typing import Any

import click

from nerfbake.cli.params import budget_options, console_options, octree_target_argument, source_argument
from nerfbake.console import Console
from nerfbake.jobs.files import Source, Target


@click.command()
@source_argument
@octree_target_argument()
@click.option(
    "--level", type=click.IntRange(min=0), required=True, help="Deepest level to keep. 0 keeps only the root."
)
@budget_options
@console_options
def lod(source: Source, target: Target, console: Console, **options: Any) -> None:
    """Reduce an octree to a coarser level of detail.

    Writes the nodes of IN from the root down to --level. A node on the last level stores the mean of everything below
    it.

    \b
      nerfbake lod chair.svo.pb chair_lod.svo.pb --level 6
    """

    from nerfbake.jobs.octrees import bake_lod

    bake_lod(source, target, steps=console, **options)
