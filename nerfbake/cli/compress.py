"""`nerfbake compress`: a PlenOctree or an octree as a file of a few megabytes."""

from __future__ import annotations

from functools import partial, wraps
from typing import Any

import click

from nerfbake import io
from nerfbake.cli.params import (
    CAPTURE,
    Command,
    Number,
    NumberRange,
    Size,
    as_json,
    reads,
    samples,
    speaks,
    without_effect,
    writes,
)
from nerfbake.cli.paths import Capture, Reads
from nerfbake.cli.words import Words
from nerfbake.jobs.budgets import Budget
from nerfbake.jobs.compressions import Goal, Photographs, compress_file
from nerfbake.jobs.files import Source, Target


def aims(function: Command) -> Command:
    """Adds --max-loss, --max-size and --step; the command gets `goal`."""

    @click.option(
        "--max-loss",
        type=NumberRange(min=0.001, max=20),
        help="The most PSNR that pictures may lose against photographs, in dB.  [default: 0.1]",
    )
    @click.option("--max-size", type=Size(), help="The most bytes that OUT may have, for example 2MB.")
    @click.option("--step", type=NumberRange(min=1e-4, max=16), help="Round colours to steps of this size.")
    @wraps(function)
    def command(*args: Any, max_loss: float | None, max_size: int | None, step: float | None, **others: Any) -> Any:
        return function(*args, goal=Goal(max_loss, max_size, step), **others)

    return command


def measures(function: Command) -> Command:
    """Adds --cameras, --truth, --samples, --source-psnr and --min-psnr; the command gets `photographs` and `budget`."""

    @click.option(
        "--cameras", metavar="CAPTURE", type=Capture(), help=f"The cameras of --truth and --min-psnr: {CAPTURE}."
    )
    @click.option("--truth", type=Reads(), help="A folder with a photograph NAME.png for each camera: measure.")
    @samples
    @click.option(
        "--source-psnr",
        type=NumberRange(min=1, max=80),
        help="How near IN comes to its photographs in dB, to predict the loss.  [default: 35]",
    )
    @click.option("--min-psnr", type=Number(), help="The least PSNR in dB: below it OUT becomes OUT.rejected (exit 3).")
    @wraps(function)
    def command(
        *args: Any,
        cameras: str | None,
        truth: str | None,
        source_psnr: float | None,
        min_psnr: float | None,
        samples: int | None,
        **others: Any,
    ) -> Any:
        if truth is None and min_psnr is None:
            for name in ("cameras", "samples"):
                allowed = f"--{name} with --truth or --min-psnr"
                without_effect(name, here="where nothing is measured", allowed=allowed)
        photographs = Photographs(cameras, truth, source_psnr, samples)
        return function(*args, photographs=photographs, budget=Budget(min_psnr, cameras, samples), **others)

    return command


@click.command()
@reads
@writes("QuantisedOctree")
@aims
@measures
@click.option("--basis", metavar="SHk", help="Lower the degree of the colours first: SH1, SH4, SH9 or SH16.")
@click.option(
    "--coding",
    type=click.Choice(["range", "deflate"]),
    default="range",
    show_default=True,
    help="range: the smallest file; deflate: about a quarter larger, and any inflate reads it.",
)
@as_json
@speaks
def compress(source: Source, target: Target, as_json: bool, words: Words, **options: Any) -> None:
    """Compress a scene with little loss.

    Compresses the PlenOctree or octree IN to OUT, as small as the allowed loss of quality permits.

    \b
      nerfbake compress chair.npz chair.svoq
      nerfbake compress chair.npz small.svoq --max-size 1MB
      nerfbake compress chair.npz chair.svoq --max-loss 0.2 --cameras transforms.json --truth photographs
    """
    if as_json and target.path == io.STREAM:
        raise click.UsageError("stdout has OUT; allowed for --json: an OUT other than '-'")
    report = partial(_print_json, source.path, target.path) if as_json else None
    compress_file(source, target, steps=words, report=report, **options)


def _print_json(source: str, target: str, found: Any) -> None:
    io.print_json({"in": source, "out": target, **found.facts})
