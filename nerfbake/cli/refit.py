"""`nerfbake refit`: an octree fitted anew, to a finer scene or to photographs."""

from __future__ import annotations

from functools import wraps
from typing import Any

import click

from nerfbake import io
from nerfbake.cli.fit import takes_album
from nerfbake.cli.params import CAPTURE, Command, as_json, reads, seed, speaks, without_effect, writes_octree
from nerfbake.cli.paths import Photographs, Reads
from nerfbake.cli.words import Words
from nerfbake.jobs.files import Source, Target
from nerfbake.jobs.photographs import Album
from nerfbake.jobs.refits import Again, Model, refit_file


def takes_model(function: Command) -> Command:
    """Adds --like with --frames and --edge, and --views with what takes_album adds; the command gets `model`."""

    @click.option("--like", metavar="BIGGER", type=Reads(), help="The finer scene that OUT is to look like.")
    @click.option(
        "--frames",
        type=click.IntRange(2, 1000),
        default=100,
        show_default=True,
        help="How many pictures of BIGGER are taken, from all sides.",
    )
    @click.option(
        "--edge",
        type=click.IntRange(8, 4096),
        default=400,
        show_default=True,
        help="The pixels of those along each edge.",
    )
    @click.option(
        "--views", metavar="SOURCE", type=Photographs(), help=f"The photographs that OUT is to look like: {CAPTURE}."
    )
    @takes_album
    @wraps(function)
    def command(
        *args: Any, like: str | None, frames: int, edge: int, views: str | None, album: Album, **others: Any
    ) -> Any:
        if like is None:
            without_effect("frames", "edge", here="on photographs", allowed="--frames and --edge with --like")
        if views is None:
            allowed = "it with --views"
            without_effect("background", "masks", "test", "holdout", here="without photographs", allowed=allowed)
        return function(*args, model=Model(like, views, frames, edge, album), **others)

    return command


@click.command()
@reads
@writes_octree()
@takes_model
@click.option(
    "--epochs", type=click.IntRange(1, 100), default=2, show_default=True, help="How often each picture is looked at."
)
@click.option(
    "--samples",
    type=click.IntRange(1, 2),
    default=2,
    show_default=True,
    help="Rays along each edge of a pixel, as pictures of OUT are to be made.",
)
@seed
@as_json
@speaks
def refit(
    source: Source,
    target: Target,
    epochs: int,
    samples: int,
    seed: int,
    as_json: bool,
    words: Words,
    **options: Any,
) -> None:
    """Make a coarse scene look like a finer one.

    Fits the values of the octree or PlenOctree IN to a finer scene or to photographs. OUT has the same nodes.

    \b
      nerfbake refit chair_128.svo.pb chair_better.svo.pb --like chair.npz
      nerfbake refit chair_lod.svo.pb chair_better.svo.pb --views capture --samples 1
    """
    found = refit_file(source, target, again=Again(epochs, samples, seed), steps=words, **options)
    if as_json:
        before, after = found.psnr
        facts = {"in": source.path, "file": found.path, "content": found.content, "bytes": found.bytes}
        facts |= {"psnr_before": before, "psnr": after, "cpu_seconds": found.worked}
        facts |= {"views": [view._asdict() for view in found.after]}
        io.print_json(facts)
