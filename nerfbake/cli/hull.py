"""`nerfbake hull`: build a mesh that encloses the visible part of a scene."""

from __future__ import annotations

from typing import Any

import click

from nerfbake.cli.function_params import function_options
from nerfbake.cli.params import console_options, source_argument, target_argument
from nerfbake.console import Console
from nerfbake.jobs.files import Source, Target


@click.command()
@source_argument
@target_argument("Meshes")
@click.option(
    "--level",
    type=click.IntRange(0, 12),
    default=5,
    show_default=True,
    help="Resolution: 2^LEVEL boxes along the longest edge of the visible part, but none smaller than a voxel.",
)
@click.option(
    "--in-up",
    type=click.Choice(["y", "z"]),
    help="Up axis of IN. z: the nodes of a .glb rotate z to y.  [default: no rotation]",
)
@function_options()
@console_options
def hull(source: Source, target: Target, console: Console, **options: Any) -> None:
    """Build a tight mesh around a scene, for engines.

    Writes OUT, a mesh of boxes that encloses everything visible in the field or the splats IN. An engine draws the
    mesh, and marches rays through the field only inside it. `nerfbake mesh` makes a mesh that looks like the scene.

    \b
      nerfbake hull chair.npz hull.glb
      nerfbake hull chair.svo.pb hull.obj --level 6
      nerfbake hull smoke.vdb hull.glb --in-up z
    """

    from nerfbake.jobs.hulls import bake_hull

    bake_hull(source, target, steps=console, **options)
