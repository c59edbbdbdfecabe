"""`nerfbake fit`: fit a sparse field to photographs."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from nerfbake import io
from nerfbake.cli.params import (
    Box,
    NumberRange,
    as_json,
    bundled,
    console_options,
    device_option,
    max_memory,
    seed,
    sh_bases,
    target_argument,
    without_effect,
)
from nerfbake.cli.paths import MeshOutput, PhotographsPath, StateFolder, Writes
from nerfbake.cli.picture_params import photograph_options, ray_samples
from nerfbake.cli.reports import require_chart, save_bytes
from nerfbake.cli.world_params import world_options
from nerfbake.console import Console
from nerfbake.jobs.files import Source, Target

if TYPE_CHECKING:
    from nerfbake.jobs.fit_options import FitOptions
    from nerfbake.jobs.fits import FitResult


def _check_schedule(options: FitOptions) -> None:
    if options.epochs is not None:
        without_effect("resolution", "samples", here="with --epochs, which has its own", allowed="one of them")


fit_options = bundled(
    "options",
    "jobs.fit_options.FitOptions",
    click.option(
        "--preset",
        type=click.Choice(["fast", "balanced", "best"]),
        help="Schedule of about 35, 65 or 120 seconds on two cores; of 2, 4 or 8 minutes for objects in pictures of "
        "600 pixels or more; of 40, 90 or 230 seconds with scenery. Longer if an object fills the pictures.  "
        "[default: balanced]",
    ),
    click.option(
        "--minutes",
        type=NumberRange(0.1, 600),
        help="Select a schedule that takes this many minutes on two cores, or on the graphics card.",
    ),
    click.option("--epochs", metavar="SCHEDULE", help="Schedule, as each run prints its own."),
    click.option(
        "--resolution",
        type=click.Choice([32, 64, 128, 256, 512]),
        help="Voxels along each axis, before those with the largest errors are split once more. With scenery: along "
        "each axis of the inner cube, after they are split.  [default: 256; 512 for objects in pictures of 600 pixels "
        "or more]",
    ),
    click.option(
        "--basis",
        type=sh_bases,
        help="Spherical-harmonics basis of the colours.  [default: SH9; SH16 with --preset best, without scenery]",
    ),
    ray_samples,
    click.option(
        "--box",
        type=Box(),
        help="Two opposite corners of the box around the object, or of the inner cube of scenery, in world "
        "coordinates.  [default: derived from the pictures]",
    ),
    click.option(
        "--exposure",
        type=click.Choice(["auto", "fit", "fixed"]),
        default="auto",
        show_default=True,
        help="fit: also fit a gain for each photograph and channel, which removes differences of exposure and of white "
        "balance. fixed: use the photographs as they are. auto: fit if they show scenery.",
    ),
    seed,
    device_option,
    check=_check_schedule,
)


@click.command()
@click.argument("source", metavar="SOURCE", type=PhotographsPath())
@target_argument("SparseVoxelOctree", "QuantisedOctree", "Volume", "Splats", "N3Tree", "Meshes", output=MeshOutput)
@fit_options
@world_options("as in the cameras; for photographs alone as in nerfbake poses")
@photograph_options  # --scenery is part of its `photographs`, too
@click.option(
    "--scenery",
    type=click.Choice(["auto", "keep", "drop"]),
    default="auto",
    show_default=True,
    help="keep: fit everything that the pictures show. drop: fit an object in front of a plain background. auto: "
    "keep if there is scenery behind the object, and neither alpha nor masks.",
)
@click.option(
    "--dtype",
    type=click.Choice(["float16", "float32"]),
    help="Number type of the values of a PlenOctree.  [default: float16]",
)
@click.option(
    "--state",
    metavar="DIR",
    type=StateFolder(),
    help="Write checkpoints to this folder. After an interruption, the same command resumes from them.",
)
@click.option("--plot", type=Writes(), help="Write a chart of the PSNR over CPU seconds: a .png or .svg.")
@max_memory
@as_json
@console_options
def fit(
    source: str,
    target: Target,
    plot: str | None,
    as_json: bool,
    console: Console,
    **options: Any,
) -> None:
    """Fit a scene to photographs.

    Fits a sparse field to the photographs and camera poses of SOURCE, and writes it to OUT: a PlenOctree, an octree, a
    volume, a textured mesh of it (`nerfbake mesh`), or Gaussian splats. If the photographs show scenery behind the
    object, OUT is a PlenOctree of all of it, or a mesh or splats of its inner cube. If SOURCE has photographs alone,
    finds their poses first, as `nerfbake poses` does. Prints the PSNR and SSIM of OUT on held-out photographs.

    \b
      nerfbake fit capture chair.npz
      nerfbake fit capture/transforms.json chair.nvdb --preset best --state checkpoints
      nerfbake fit capture chair.svo.pb --masks masks --minutes 3 --json
      nerfbake fit flight town.glb --scale gps --ground
    """

    from nerfbake.jobs.fits import fit_file

    if plot:
        require_chart(plot, force=target.force)
    fitted = fit_file(Source(source), target, steps=console, **options)
    if plot:
        save_bytes(plot, _chart(source, fitted, Path(plot).suffix), force=target.force)
    if as_json:
        io.print_json(_facts(source, fitted))


def _facts(source: str, fitted: FitResult) -> dict[str, Any]:
    return {
        "source": source,
        "file": fitted.path,
        "content": fitted.content,
        "bytes": fitted.bytes,
        "epochs": fitted.schedule,
        "device": fitted.device,
        "psnr": fitted.psnr,
        "corrected": fitted.corrected,
        "ssim": fitted.ssim,
        "cpu_seconds": fitted.worked,
        "seconds": fitted.passed,
        "views": [view._asdict() for view in fitted.views],
        "curve": [point._asdict() for point in fitted.curve],
        "overlap": fitted.overlap,
        "agreement": fitted.agreement,
        "alone": list(fitted.alone),
    }


def _chart(source: str, fitted: FitResult, suffix: str) -> bytes:
    from nerfbake.bench.plot import lines

    curves = {"during the fit": [(point.seconds, point.psnr) for point in fitted.curve]}
    curves["the written file"] = [(fitted.worked, fitted.psnr)]
    title = f"{Path(source).name}: held-out views"
    return lines(curves, title=title, x="CPU seconds", y="PSNR dB", suffix=suffix)
