"""`nerfbake frames`: take the sharp frames of a video."""

from __future__ import annotations

import click

from nerfbake import io
from nerfbake.cli.params import as_json, console_options, max_memory
from nerfbake.cli.paths import Reads, Writes
from nerfbake.console import Console


@click.command()
@click.argument("source", metavar="VIDEO", type=Reads())
@click.argument("target", metavar="OUT_DIR", type=Writes())
@click.option(
    "--count",
    type=click.IntRange(min=1),
    help="Number of frames, or all if VIDEO has fewer.  [default: two a second, but 40 to 150]",
)
@click.option("--force", is_flag=True, help="Replace OUT_DIR if it contains nothing but frames.")
@max_memory
@as_json
@console_options
def frames(source: str, target: str, count: int | None, force: bool, as_json: bool, console: Console) -> None:
    """Take the sharp frames of a video.

    Writes OUT_DIR with photographs as JPEG, for `nerfbake fit`: VIDEO is cut into stretches, and the sharpest frame of
    each is taken, upright. Needs PyAV, which the extra `video` installs.

    \b
      nerfbake frames walk.mp4 photographs && nerfbake fit photographs scene.npz
      nerfbake frames walk.mov photographs --count 200 --json
    """

    from nerfbake.jobs.frames import take_frames

    taken = take_frames(source, target, count=count, force=force, steps=console)
    if as_json:
        io.print_json(taken._asdict())
