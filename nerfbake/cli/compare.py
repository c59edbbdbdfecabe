"""`nerfbake compare`: measure the difference between two scenes."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any

import click

from nerfbake import io
from nerfbake.cli.function_params import world_option
from nerfbake.cli.params import (
    CAPTURE,
    Number,
    PixelSize,
    as_json,
    bundled,
    console_options,
    device_option,
    samples,
    source_argument,
    without_effect,
)
from nerfbake.cli.paths import Capture, Reads, Writes
from nerfbake.console import Console
from nerfbake.errors import one_line
from nerfbake.jobs.files import Source

if TYPE_CHECKING:
    from nerfbake.jobs.comparisons import ComparisonOutputs, FileComparison


view_options = bundled(
    "seen",
    "jobs.comparisons.ComparedViews",
    click.option(
        "--cameras", metavar="CAPTURE", type=Capture(), help=f"Cameras: {CAPTURE}.  [default: 8 views around IN]"
    ),
    click.option("--truth", type=Reads(), help="Folder with a photograph NAME.png for each camera."),
    click.option(
        "--size",
        type=PixelSize(),
        help="Picture size in pixels.  [default: that of the photographs or cameras; 400x400 for an orbit]",
    ),
    samples,
    world_option,
    device_option,
)
limit_options = bundled(
    "limits",
    "jobs.comparisons.ComparisonLimits",
    click.option(
        "--min-psnr",
        type=Number(),
        help="Lowest allowed mean PSNR of IN2 against IN, in dB. Below it, exit with code 3.",
    ),
    click.option(
        "--max-error",
        type=Number(),
        help="Largest allowed difference in any channel of any pixel (0..1). Above it, exit with code 3.",
    ),
)


def _check_outputs(pages: ComparisonOutputs) -> None:
    if not pages:
        without_effect("force", here="without --sheet or --html", allowed="--force with --sheet or --html")


output_options = bundled(
    "pages",
    "jobs.comparisons.ComparisonOutputs",
    click.option(
        "--sheet",
        type=Writes(),
        help="Write a PNG with the pictures of the truth, IN and IN2, and their differences times 8.",
    ),
    click.option("--html", type=Writes(), help="Write an HTML page with limits, figures, sizes and pictures."),
    click.option("--force", is_flag=True, help="Replace the files of --sheet and --html if they exist."),
    check=_check_outputs,
)


@click.command()
@source_argument
@click.argument("other", metavar="IN2", type=Reads())
@view_options
@limit_options
@output_options
@as_json
@console_options
def compare(source: Source, other: str, as_json: bool, console: Console, **options: Any) -> None:
    """Measure how different two scenes look.

    Renders IN and IN2 with the same cameras, and prints the PSNR, the SSIM and the largest error of their pictures.

    A scene is a file with a field or a mesh, a stage-1 folder of nerf2mesh, or an atlas folder.

    \b
      nerfbake compare chair.npz chair.svo.pb
      nerfbake compare chair.npz small.svo.pb --min-psnr 30 --html small.html
      nerfbake compare mesh_stage1 atlas_64 --sheet atlas.png
    """

    from nerfbake.jobs.comparisons import compare_files

    report = partial(_print_json, source.path, other) if as_json else _print
    compare_files(source, other, steps=console, report=report, **options)


def _print_json(a: str, b: str, compared: FileComparison) -> None:
    found, sizes = compared.found, {"a": compared.a["bytes"], "b": compared.b["bytes"]}
    facts = {"a": a, "b": b, "mean": found.means, "values": found.values, "views": found.views}
    io.print_json({**facts, "bytes": sizes, "samples": found.samples})


def _print(compared: FileComparison) -> None:
    found = compared.found
    names = {"a_b": "IN - IN2", "a_truth": "IN - truth", "b_truth": "IN2 - truth"}
    io.print_text(f"{'view':<12}{'':<14}{'PSNR dB':>9}{'SSIM':>9}{'max error':>11}")
    rows: list[dict[str, Any]] = [*found.views, {"name": "mean", **found.means}]
    for view in rows:
        for pair, errors in view.items():
            if pair != "name":
                figures = f"{errors['psnr']:>9.2f}{errors['ssim']:>9.4f}{errors['max_error']:>11.4f}"
                io.print_text(f"{one_line(view['name']):<12}{names[pair]:<14}{figures}")
    for name, errors in found.values.items():
        io.print_text(f"{'values':<12}{name:<14}mean {errors['mean']:.4g}, max {errors['max']:.4g}")
    for name, file in (("IN", compared.a), ("IN2", compared.b)):
        io.print_text(f"{'bytes':<12}{name:<14}{file['bytes']:,}")
    if found.samples > 1:
        io.print_text(f"{'rays':<12}{'a pixel':<14}{found.samples}x{found.samples}")
