"""`nerfbake compress`: compress a scene to a few megabytes."""

from __future__ import annotations

from functools import partial, wraps
from typing import Any

import click

from nerfbake import io
from nerfbake.cli.function_params import function_options
from nerfbake.cli.params import (
    CAPTURE,
    Command,
    NumberRange,
    as_json,
    bundled,
    console_options,
    device_option,
    max_loss,
    max_size,
    min_psnr,
    samples,
    source_argument,
    target_argument,
    truth,
    without_effect,
)
from nerfbake.cli.paths import Capture
from nerfbake.console import Console
from nerfbake.jobs.budgets import Budget
from nerfbake.jobs.files import Source, Target

goal_options = bundled(
    "goal",
    "jobs.compressions.CompressionGoal",
    max_loss("0.1"),
    max_size,
    click.option(
        "--step",
        type=NumberRange(min=1e-4, max=16),
        help="Quantisation step of the colours, instead of a limit for loss or size.",
    ),
)


def quality_options(function: Command) -> Command:
    """Add --cameras, --truth, --samples, --source-psnr, --min-psnr and --device; pass the command
    `photographs` and `budget`.
    """

    @click.option(
        "--cameras", metavar="CAPTURE", type=Capture(), help=f"Cameras for --truth and --min-psnr: {CAPTURE}."
    )
    @truth("camera")
    @samples
    @click.option(
        "--source-psnr",
        type=NumberRange(min=1, max=80),
        help="PSNR of IN against its photographs in dB, to predict the loss from.  [default: 30.5]",
    )
    @min_psnr
    @device_option
    @wraps(function)
    def command(
        *args: object,
        cameras: str | None,
        truth: str | None,
        source_psnr: float | None,
        min_psnr: float | None,
        samples: int | None,
        device: str,
        **others: object,
    ) -> object:
        from nerfbake.jobs.compressions import GroundTruth

        if truth is None and min_psnr is None:
            for name in ("cameras", "samples"):
                allowed = f"--{name} with --truth or --min-psnr"
                without_effect(name, here="without --truth or --min-psnr", allowed=allowed)
        photographs = GroundTruth(cameras=cameras, truth=truth, source_psnr=source_psnr, samples=samples)
        budget = Budget(min_psnr=min_psnr, cameras=cameras, samples=samples, device=device)
        return function(*args, photographs=photographs, budget=budget, **others)

    return command


@click.command()
@source_argument
@target_argument("QuantisedOctree")
@goal_options
@quality_options
@click.option("--basis", metavar="SHk", help="Reduce the colours to this SH basis first: SH1, SH4, SH9 or SH16.")
@click.option(
    "--coding",
    type=click.Choice(["range", "deflate"]),
    default="range",
    show_default=True,
    help="range: the smallest file; deflate: about a quarter larger, but any inflate can decode it.",
)
@function_options("basis")
@as_json
@console_options
def compress(source: Source, target: Target, as_json: bool, console: Console, **options: Any) -> None:
    """Compress a scene with little loss.

    Compresses the PlenOctree, octree, volume, lattice or splats IN to the smallest OUT that keeps the loss of quality
    within --max-loss, or to the best OUT that is no larger than --max-size.

    \b
      nerfbake compress chair.npz chair.svoq
      nerfbake compress chair.npz small.svoq --max-size 1MB
      nerfbake compress chair.npz chair.svoq --max-loss 0.2 --cameras transforms.json --truth photographs
    """

    from nerfbake.jobs.compressions import compress_file

    if as_json and target.path == io.STREAM:
        raise click.UsageError("--json writes to stdout, which is OUT; allowed: an OUT other than '-'")
    report = partial(_print_json, source.path, target.path) if as_json else None
    compress_file(source, target, steps=console, report=report, **options)


def _print_json(source: str, target: str, found: Any) -> None:
    io.print_json({"in": source, "out": target, **found.facts})
