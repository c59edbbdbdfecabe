"""`nerfbake fit`: photographs to a sparse field."""

from __future__ import annotations

from functools import wraps
from pathlib import Path
from typing import Any, ClassVar

import click

from nerfbake import io
from nerfbake.cli.params import (
    Command,
    NumberRange,
    as_json,
    max_memory,
    seed,
    sh_basis,
    speaks,
    without_effect,
    writes,
)
from nerfbake.cli.paths import Keeps, Photographs, Reads, Writes
from nerfbake.cli.render import Background
from nerfbake.cli.reports import require_chart, save_bytes
from nerfbake.cli.words import Words
from nerfbake.jobs.files import Source, Target
from nerfbake.jobs.fits import FITTED, Fitted, Recipe, fit_file
from nerfbake.jobs.photographs import Album


class Behind(Background):
    """auto, white, black, or R,G,B in 0..255."""

    known: ClassVar = {"auto": None, "white": (1.0, 1.0, 1.0), "black": (0.0, 0.0, 0.0)}


class Box(click.ParamType[tuple[float, ...]]):
    """Two opposite corners in the world."""

    name = "x0,y0,z0,x1,y1,z1"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[float, ...]:
        try:
            corners = tuple(map(float, value.split(",")))
        except ValueError:
            corners = ()
        fine = len(corners) == 6 and all(
            -1e15 < low < high < 1e15 for low, high in zip(corners, corners[3:], strict=False)
        )
        if not fine:
            self.fail(f"{value!r} is no box; allowed: x0,y0,z0,x1,y1,z1, each below its opposite", param, ctx)
        return corners


def takes_album(function: Command) -> Command:
    """Adds --background, --masks, --test and --holdout; the command gets `album`."""

    @click.option(
        "--background",
        type=Behind(),
        default="auto",
        show_default=True,
        help="What is behind the object: white, black or R,G,B. auto: white for pictures with alpha, "
        "else the colour at the pictures' edges.",
    )
    @click.option(
        "--masks",
        metavar="DIR",
        type=Reads(),
        help="A folder with a mask NAME.png for each picture, white where the object is: for scenery behind it.",
    )
    @click.option(
        "--test",
        metavar="CAPTURE",
        type=Photographs(readable=False),
        help="Other cameras, whose pictures judge the result.",
    )
    @click.option(
        "--holdout",
        metavar="N",
        type=click.IntRange(min=2),
        help="Keep every N-th view for judging.  [default: 8, but none where SOURCE has views to test with]",
    )
    @wraps(function)
    def command(
        *args: Any, background: Any, masks: str | None, test: str | None, holdout: int | None, **others: Any
    ) -> Any:
        return function(*args, album=Album(background, masks, test, holdout), **others)

    return command


def takes_recipe(function: Command) -> Command:
    """Adds the options of a Recipe; the command gets `recipe`."""

    @click.option(
        "--preset",
        type=click.Choice(["fast", "balanced", "best"]),
        help="A schedule of about 40, 80 or 140 seconds on two cores.  [default: balanced]",
    )
    @click.option("--minutes", type=NumberRange(0.1, 600), help="Choose a schedule for so long on two cores.")
    @click.option("--epochs", metavar="SCHEDULE", help="A schedule, as this command prints the one that it follows.")
    @click.option(
        "--resolution",
        type=click.Choice(["32", "64", "128", "256", "512"]),
        default="256",
        show_default=True,
        help="Voxels along each axis, before those that need it are split once more.",
    )
    @sh_basis
    @click.option(
        "--samples",
        type=click.IntRange(1, 2),
        default=2,
        show_default=True,
        help="Rays along each edge of a pixel, as pictures of OUT are to be made: 2 for averaged photographs.",
    )
    @click.option(
        "--box", type=Box(), help="Two corners of the box around the object.  [default: as the pictures tell]"
    )
    @seed
    @wraps(function)
    def command(
        *args: Any,
        preset: str | None,
        minutes: float | None,
        epochs: str | None,
        resolution: str,
        basis: str,
        samples: int,
        box: Any,
        seed: int,
        **others: Any,
    ) -> Any:
        if epochs is not None:
            without_effect("resolution", "samples", here="with --epochs, which has its own", allowed="one of them")
        recipe = Recipe(preset, minutes, epochs, int(resolution), samples, basis, box, seed)
        return function(*args, recipe=recipe, **others)

    return command


@click.command()
@click.argument("source", metavar="SOURCE", type=Photographs())
@writes(*FITTED)
@takes_recipe
@takes_album
@click.option(
    "--dtype",
    type=click.Choice(["float16", "float32"]),
    help="Type of the values of a PlenOctree.  [default: float16]",
)
@click.option(
    "--state",
    metavar="DIR",
    type=Keeps(),
    help="Keep checkpoints in this folder; the same command goes on from there after it was stopped.",
)
@click.option("--plot", type=Writes(), help="Draw the PSNR over CPU seconds, as .png or .svg.")
@max_memory
@as_json
@speaks
def fit(source: str, target: Target, plot: str | None, as_json: bool, words: Words, **options: Any) -> None:
    """Fit a scene to photographs.

    The photographs of SOURCE, and the cameras that took them, become OUT: a PlenOctree, an octree or a volume.

    \b
      nerfbake fit capture chair.npz
      nerfbake fit capture/transforms.json chair.nvdb --preset best --state checkpoints
      nerfbake fit capture chair.svo.pb --masks masks --minutes 3 --json
    """
    if plot:
        require_chart(plot, force=target.force)
    fitted = fit_file(Source(source), target, steps=words, **options)
    if plot:
        save_bytes(plot, _chart(source, fitted, Path(plot).suffix), force=target.force)
    if as_json:
        io.print_json(_facts(source, fitted))


def _facts(source: str, fitted: Fitted) -> dict[str, Any]:
    return {
        "source": source,
        "file": fitted.path,
        "content": fitted.content,
        "bytes": fitted.bytes,
        "epochs": fitted.schedule,
        "psnr": fitted.psnr,
        "ssim": fitted.ssim,
        "cpu_seconds": fitted.worked,
        "seconds": fitted.passed,
        "views": [view._asdict() for view in fitted.views],
        "curve": [point._asdict() for point in fitted.curve],
    }


def _chart(source: str, fitted: Fitted, suffix: str) -> bytes:
    from nerfbake.bench.plot import lines

    curves = {"while it was fitted": [(point.seconds, point.psnr) for point in fitted.curve]}
    curves["the written file"] = [(fitted.worked, fitted.psnr)]
    title = f"{Path(source).name}: views that were kept for judging"
    return lines(curves, title=title, x="CPU seconds", y="PSNR dB", suffix=suffix)
