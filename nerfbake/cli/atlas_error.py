"""`nerfbake atlas-error`: measure the error of an atlas against the MLP that it replaces."""

from __future__ import annotations

from typing import Any

import click

from nerfbake import io
from nerfbake.cli.params import as_json, console_options, max_memory, without_effect
from nerfbake.cli.paths import Reads
from nerfbake.console import Console


@click.command("atlas-error")
@click.argument("atlas", metavar="OUT_DIR", type=Reads())
@click.argument("stage1", metavar="STAGE1_DIR", type=Reads())
@click.option(
    "--lookup",
    type=click.Choice(["bilinear", "nearest", "thesis"]),
    default="bilinear",
    show_default=True,
    help="Lookup in the maps. thesis: texel int(uv (R - 1)), with colours truncated instead of rounded.",
)
@click.option(
    "--directions",
    type=click.IntRange(1, 4096),
    default=100,
    show_default=True,
    help="Number of evenly spread directions.",
)
@click.option("--held-out", is_flag=True, help="Measure in 617 other directions, which no bake uses.")
@click.option(
    "--reproduce-thesis-fault",
    "thesis_fault",
    is_flag=True,
    help="Evaluate the MLP in directions that are not unit vectors, as the published evaluation does.",
)
@max_memory
@as_json
@console_options
def atlas_error(atlas: str, stage1: str, as_json: bool, console: Console, **options: Any) -> None:
    """Measure an atlas against the MLP that it replaces.

    Prints the mean absolute and squared error (0..255) of the atlas OUT_DIR against the MLP of STAGE1_DIR.

    The means cover every used texel, direction and channel. OUT_DIR may also be a folder that the code of the K-means
    thesis wrote.

    \b
      nerfbake atlas-error atlas mesh_stage1 --held-out
      nerfbake atlas-error thesis_16x64 crop64 --lookup thesis --reproduce-thesis-fault
    """

    from nerfbake.jobs.atlases import measure_atlas

    if options["held_out"]:
        without_effect("directions", here="with --held-out, which has its own", allowed="one of them")
    errors = measure_atlas(atlas, stage1, steps=console, **options)
    if as_json:
        io.print_json({"errors": [error._asdict() for error in errors]})
        return
    for cascade, error in enumerate(errors):
        io.print_text(f"cascade {cascade}: MAE {error.mae:.9f}, MSE {error.mse:.9f} as 8-bit pictures hold them")
        io.print_text(f"cascade {cascade}: MAE {error.mae_float:.9f}, MSE {error.mse_float:.9f} before rounding")
