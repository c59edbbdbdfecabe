"""`nerfbake compare`: what one scene lost against another."""

from __future__ import annotations

from functools import partial, wraps
from typing import Any

import click

from nerfbake import io
from nerfbake.cli.params import CAPTURE, Command, Number, PixelSize, as_json, reads, samples, speaks, without_effect
from nerfbake.cli.paths import Capture, Reads, Writes
from nerfbake.cli.words import Words
from nerfbake.jobs.comparisons import Compared, Limits, Pages, Seen, compare_files
from nerfbake.jobs.files import Source


def sees(function: Command) -> Command:
    """Adds --cameras, --truth, --size and --samples; the command gets `seen`."""

    @click.option(
        "--cameras", metavar="CAPTURE", type=Capture(), help=f"The cameras: {CAPTURE}.  [default: 8 views around IN]"
    )
    @click.option("--truth", type=Reads(), help="A folder with a photograph NAME.png for each camera.")
    @click.option(
        "--size", type=PixelSize(), help="Size in pixels.  [default: the truth's or the cameras', 400x400 for an orbit]"
    )
    @samples
    @wraps(function)
    def command(
        *args: Any, cameras: str | None, truth: str | None, size: Any, samples: int | None, **others: Any
    ) -> Any:
        return function(*args, seen=Seen(cameras, truth, size, samples), **others)

    return command


def limits(function: Command) -> Command:
    """Adds --min-psnr and --max-error; the command gets `limits`."""

    @click.option("--min-psnr", type=Number(), help="Exit 3 if the mean PSNR of IN2 against IN is lower (dB).")
    @click.option("--max-error", type=Number(), help="Exit 3 if any channel of any pixel differs by more (0..1).")
    @wraps(function)
    def command(*args: Any, min_psnr: float | None, max_error: float | None, **others: Any) -> Any:
        return function(*args, limits=Limits(min_psnr, max_error), **others)

    return command


def writes_pages(function: Command) -> Command:
    """Adds --sheet, --html and --force; the command gets `pages`."""

    @click.option(
        "--sheet",
        type=Writes(),
        help="Write a PNG with the pictures of truth, IN and IN2, and their differences times 8.",
    )
    @click.option("--html", type=Writes(), help="Write a page with budgets, figures, sizes and pictures.")
    @click.option("--force", is_flag=True, help="Replace the sheet and the page if they exist.")
    @wraps(function)
    def command(*args: Any, sheet: str | None, html: str | None, force: bool, **others: Any) -> Any:
        if not (sheet or html):
            without_effect("force", here="where nothing is written", allowed="--force with --sheet or --html")
        return function(*args, pages=Pages(sheet, html, force), **others)

    return command


@click.command()
@reads
@click.argument("other", metavar="IN2", type=Reads())
@sees
@limits
@writes_pages
@as_json
@speaks
def compare(source: Source, other: str, as_json: bool, words: Words, **options: Any) -> None:
    """Measure how different two scenes look.

    Renders IN and IN2 with the same cameras and prints how far their pictures are apart.

    Scenes are files of fields or meshes, and the folders of nerf2mesh's stage 1 and of its atlases.

    \b
      nerfbake compare chair.npz chair.svo.pb
      nerfbake compare chair.npz small.svo.pb --min-psnr 30 --html small.html
      nerfbake compare mesh_stage1 atlas_64 --sheet atlas.png
    """
    report = partial(_print_json, source.path, other) if as_json else _print
    compare_files(source, other, steps=words, report=report, **options)


def _print_json(a: str, b: str, compared: Compared) -> None:
    found, sizes = compared.found, {"a": compared.a["bytes"], "b": compared.b["bytes"]}
    facts = {"a": a, "b": b, "mean": found.means, "values": found.values, "views": found.views}
    io.print_json({**facts, "bytes": sizes, "samples": found.samples})


def _print(compared: Compared) -> None:
    found = compared.found
    names = {"a_b": "IN - IN2", "a_truth": "IN - truth", "b_truth": "IN2 - truth"}
    io.print_text(f"{'view':<12}{'':<14}{'PSNR dB':>9}{'SSIM':>9}{'max error':>11}")
    rows: list[dict[str, Any]] = [*found.views, {"name": "mean", **found.means}]
    for view in rows:
        for pair, errors in view.items():
            if pair != "name":
                figures = f"{errors['psnr']:>9.2f}{errors['ssim']:>9.4f}{errors['max_error']:>11.4f}"
                io.print_text(f"{view['name']:<12}{names[pair]:<14}{figures}")
    for name, errors in found.values.items():
        io.print_text(f"{'values':<12}{name:<14}mean {errors['mean']:.4g}, max {errors['max']:.4g}")
    for name, file in (("IN", compared.a), ("IN2", compared.b)):
        io.print_text(f"{'bytes':<12}{name:<14}{file['bytes']:,}")
    if found.samples > 1:
        io.print_text(f"{'rays':<12}{'a pixel':<14}{found.samples}x{found.samples}")
