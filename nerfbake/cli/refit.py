"""`nerfbake refit`: fit the values of an octree to a finer scene or to photographs."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import click

from nerfbake import io
from nerfbake.cli.params import (
    CAPTURE,
    as_json,
    bundled,
    console_options,
    device_option,
    octree_target_argument,
    seed,
    source_argument,
    without_effect,
)
from nerfbake.cli.paths import PhotographsPath, Reads
from nerfbake.cli.picture_params import photograph_options, ray_samples, rendered_options, require_photographs
from nerfbake.console import Console
from nerfbake.jobs.files import Source, Target

if TYPE_CHECKING:
    from nerfbake.jobs.refits import RefitReference


def _check_reference(reference: RefitReference) -> None:
    if reference.like is None:
        without_effect("frames", "edge", here="without --like", allowed="--frames and --edge with --like")
    require_photographs(reference.views)


reference_options = bundled(
    "reference",
    "jobs.refits.RefitReference",
    click.option("--like", metavar="BIGGER", type=Reads(), help="Finer scene or splats that OUT is fitted to."),
    *rendered_options("With --like", "BIGGER to render, from all sides"),
    click.option(
        "--views",
        metavar="SOURCE",
        type=PhotographsPath(),
        help=f"Photographs that OUT is fitted to: {CAPTURE}.",
    ),
    photograph_options,
    check=_check_reference,
)


@click.command()
@source_argument
@octree_target_argument()
@reference_options
@click.option(
    "--epochs", type=click.IntRange(1, 100), default=2, show_default=True, help="Number of passes over the pictures."
)
@ray_samples
@device_option
@seed
@as_json
@console_options
def refit(
    source: Source,
    target: Target,
    epochs: int,
    samples: int,
    seed: int,
    as_json: bool,
    console: Console,
    **options: Any,
) -> None:
    """Make a coarse scene look like a finer one.

    Fits the values of the octree IN, or of the octree of another scene, to a finer scene or splats (--like) or to
    photographs (--views). OUT has the same nodes as IN.

    \b
      nerfbake refit chair_128.svo.pb chair_better.svo.pb --like chair.npz
      nerfbake refit chair_lod.svo.pb chair_better.svo.pb --views capture --samples 1
    """

    from nerfbake.jobs.refits import RefitOptions, refit_file

    found = refit_file(
        source, target, options=RefitOptions(epochs=epochs, samples=samples, seed=seed), steps=console, **options
    )
    if as_json:
        before, after = found.psnr
        facts = {"in": source.path, "file": found.path, "content": found.content, "bytes": found.bytes}
        facts |= {"psnr_before": before, "psnr": after, "cpu_seconds": found.worked}
        facts |= {"views": [view._asdict() for view in found.after]}
        io.print_json(facts)
