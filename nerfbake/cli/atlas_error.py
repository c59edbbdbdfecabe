"""`nerfbake atlas-error`: how far an atlas is from the MLP that it stands for."""

from __future__ import annotations

from typing import Any

import click

from nerfbake import io
from nerfbake.cli.params import as_json, max_memory, speaks, without_effect
from nerfbake.cli.paths import Reads
from nerfbake.cli.words import Words
from nerfbake.jobs.atlases import measure_atlas


@click.command("atlas-error")
@click.argument("atlas", metavar="OUT_DIR", type=Reads())
@click.argument("stage1", metavar="STAGE1_DIR", type=Reads())
@click.option(
    "--lookup",
    type=click.Choice(["bilinear", "nearest", "thesis"]),
    default="bilinear",
    show_default=True,
    help="How maps are read. thesis: texel int(uv (R - 1)), and colours are truncated instead of rounded.",
)
@click.option(
    "--directions",
    type=click.IntRange(1, 4096),
    default=100,
    show_default=True,
    help="How many evenly spread directions.",
)
@click.option("--held-out", is_flag=True, help="Measure in 617 other directions, which no bake has seen.")
@click.option(
    "--reproduce-thesis-fault",
    "thesis_fault",
    is_flag=True,
    help="Ask the MLP at directions that are not unit vectors, as the published evaluation does.",
)
@max_memory
@as_json
@speaks
def atlas_error(atlas: str, stage1: str, as_json: bool, words: Words, **options: Any) -> None:
    """Measure an atlas against the MLP that it replaces.

    Prints the mean absolute and squared error (0..255) of the atlas OUT_DIR against the MLP of STAGE1_DIR.

    Over every used texel, direction and channel; OUT_DIR may also be what the K-means thesis' own code wrote.

    \b
      nerfbake atlas-error atlas mesh_stage1 --held-out
      nerfbake atlas-error thesis_16x64 crop64 --lookup thesis --reproduce-thesis-fault
    """
    if options["held_out"]:
        without_effect("directions", here="with --held-out, which has its own", allowed="one of them")
    errors = measure_atlas(atlas, stage1, steps=words, **options)
    if as_json:
        io.print_json({"errors": [error._asdict() for error in errors]})
        return
    for cascade, error in enumerate(errors):
        io.print_text(f"cascade {cascade}: MAE {error.mae:.9f}, MSE {error.mse:.9f} as 8-bit pictures hold them")
        io.print_text(f"cascade {cascade}: MAE {error.mae_float:.9f}, MSE {error.mse_float:.9f} before rounding")
