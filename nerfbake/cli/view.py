"""`nerfbake view`: a page to look around in."""

from __future__ import annotations

from functools import wraps
from typing import Any

import click

from nerfbake.cli.params import (
    CAPTURE,
    Command,
    Number,
    NumberRange,
    Size,
    reads,
    samples,
    speaks,
    without_effect,
    writes,
)
from nerfbake.cli.paths import Capture, Reads
from nerfbake.cli.render import Background, places_mesh
from nerfbake.cli.volumes import chooses_grids
from nerfbake.cli.words import Words
from nerfbake.jobs.compressions import Goal
from nerfbake.jobs.files import Source, Target
from nerfbake.jobs.viewing import view_file


def carries(function: Command) -> Command:
    """Adds --data, --max-loss and --max-size; the command gets `data` and `goal`."""

    @click.option(
        "--data",
        type=click.Choice(["compressed", "exact"]),
        help="What OUT carries. compressed: as `nerfbake compress` does it; exact: float16, about ten times as large."
        "  [default: compressed, but exact of a volume]",
    )
    @click.option(
        "--max-loss",
        type=NumberRange(min=0.001, max=20),
        help="The most PSNR that pictures may lose against photographs, in dB.  "
        "[default: 0.1, or more where OUT would take more than 6 MB]",
    )
    @click.option("--max-size", type=Size(), help="The most bytes that OUT may have, for example 2MB.")
    @wraps(function)
    def command(*args: Any, data: Any, max_loss: float | None, max_size: int | None, **others: Any) -> Any:
        if data == "exact":
            here = "on exact data"
            without_effect("max_loss", "max_size", "truth", here=here, allowed="with --data compressed")
        return function(*args, data=data, goal=Goal(max_loss, max_size), **others)

    return command


def measures(function: Command) -> Command:
    """Adds --truth, --min-psnr and --samples; the command gets all three."""

    @click.option(
        "--truth",
        type=Reads(),
        help="A folder with a photograph NAME.png for each of --cameras: the loss is measured, not predicted.",
    )
    @click.option(
        "--min-psnr",
        type=Number(),
        help="The least PSNR in dB of what OUT shows: below it OUT becomes OUT.rejected (exit 3).",
    )
    @samples
    @wraps(function)
    def command(*args: Any, truth: str | None, min_psnr: float | None, **others: Any) -> Any:
        if truth is None and min_psnr is None:
            allowed = "--samples with --truth or --min-psnr"
            without_effect("samples", here="where nothing is measured", allowed=allowed)
        return function(*args, truth=truth, min_psnr=min_psnr, **others)

    return command


@click.command()
@reads
@writes("Page", required=False)
@carries
@measures
@click.option("--title", help="Title of the page.  [default: the name of IN, without its ending]")
@click.option(
    "--background",
    type=Background(),
    default="transparent",
    show_default=True,
    help="white, black, R,G,B, or transparent: light or dark, as the reader has it.",
)
@click.option(
    "--lookup",
    type=click.Choice(["nearest", "trilinear"]),
    default="nearest",
    show_default=True,
    help="How OUT opens: cells as they are, or values interpolated between their centres; the page can switch.",
)
@places_mesh
@click.option("--stage1", type=Reads(), help="Of an atlas IN: the stage-1 folder it was baked from, to show both.")
@click.option(
    "--cameras",
    metavar="CAPTURE",
    type=Capture(),
    help=f"Where to look from: {CAPTURE}.  [default: the front, turning]",
)
@chooses_grids
@speaks
def view(source: Source, target: Target | None, words: Words, **options: Any) -> None:
    """Make a web page to look around in.

    Writes OUT, one HTML page that shows IN in any browser and can be mailed.

    IN is a PlenOctree, an octree, a volume, or a folder with its mesh: nerf2mesh's stage 1, or an atlas. Without OUT
    the page is a temporary one, and opens at once.

    \b
      nerfbake view chair.npz
      nerfbake view chair.npz chair.html
      nerfbake view chair.npz small.html --max-size 1MB --title "A chair"
      nerfbake view chair.svo.pb chair.html --data exact --cameras transforms.json
      nerfbake view chair.npz room.html --mesh room.glb
      nerfbake view atlas_64 atlas.html --stage1 mesh_stage1
    """
    view_file(source, target, steps=words, **options)
