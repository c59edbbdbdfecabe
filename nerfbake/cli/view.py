"""`nerfbake view`: a page to look around in."""

from __future__ import annotations

from functools import wraps
from typing import Any

import click

from nerfbake.cli.params import CAPTURE, Command, Size, reads, speaks, without_effect, writes
from nerfbake.cli.render import Background
from nerfbake.cli.words import Words
from nerfbake.jobs.compressions import Goal
from nerfbake.jobs.files import Source, Target
from nerfbake.jobs.viewing import view_file


def carries(function: Command) -> Command:
    """Adds --data, --max-loss and --max-size; the command gets `data` and `goal`."""

    @click.option(
        "--data",
        type=click.Choice(["compressed", "exact"]),
        default="compressed",
        show_default=True,
        help="What OUT carries. compressed: as `nerfbake compress` does it; exact: float16, about ten times as large.",
    )
    @click.option(
        "--max-loss",
        type=click.FloatRange(min=0.001, max=20),
        help="The most PSNR that pictures may lose against photographs, in dB, as predicted.  [default: 0.1]",
    )
    @click.option("--max-size", type=Size(), help="The most bytes that OUT may have, for example 2MB.")
    @wraps(function)
    def command(*args: Any, data: str, max_loss: float | None, max_size: int | None, **others: Any) -> Any:
        if data == "exact":
            without_effect("max_loss", "max_size", here="on exact data", allowed="with --data compressed")
        return function(*args, data=data, goal=Goal(max_loss, max_size), **others)

    return command


@click.command()
@reads
@writes("Page")
@carries
@click.option("--title", help="What the page is called.  [default: the name of IN]")
@click.option(
    "--background",
    type=Background(),
    default="transparent",
    show_default=True,
    help="white, black, R,G,B, or transparent: light or dark, as the reader has it.",
)
@click.option("--cameras", metavar="CAPTURE", help=f"Where to look from: {CAPTURE}.  [default: the front, turning]")
@speaks
def view(source: Source, target: Target, words: Words, **options: Any) -> None:
    """Write OUT, one HTML page that shows the PlenOctree or octree IN in any browser, and can be mailed.

    \b
      nerfbake view chair.npz chair.html
      nerfbake view chair.npz small.html --max-size 1MB --title "A chair"
      nerfbake view chair.svo.pb chair.html --data exact --cameras transforms.json
    """
    view_file(source, target, steps=words, **options)
