"""`nerfbake view`: write a web page that shows a scene."""

from __future__ import annotations

from typing import Any

import click

from nerfbake.cli.function_params import function_options
from nerfbake.cli.params import (
    CAPTURE,
    bundled,
    console_options,
    device_option,
    grid_options,
    max_loss,
    max_size,
    min_psnr,
    samples,
    source_argument,
    target_argument,
    truth,
    without_effect,
)
from nerfbake.cli.paths import Capture, Reads
from nerfbake.cli.render import Background, mesh_options
from nerfbake.console import Console
from nerfbake.jobs.files import Source, Target

_VALUES = {"goal", "choice", "mesh"}  # of several options each
_OF_FIELDS = {
    "data",
    "max_loss",
    "max_size",
    "truth",
    "samples",
    "lookup",
    "mesh_up",
    "how",
    "stage1",
    "grids",
    "in_up",
} | _VALUES


@click.command()
@source_argument
@target_argument("Page", required=False)
@click.option(
    "--as",
    "shown_as",
    type=click.Choice(["field", "splats"]),
    default="field",
    show_default=True,
    help="What OUT draws. field: voxels along rays; splats: the splats IN, or splats fitted to a field.",
)
@click.option(
    "--data",
    type=click.Choice(["compressed", "exact"]),
    help="Data in OUT. compressed: the data of `nerfbake compress`; exact: float16, about ten times as large."
    "  [default: compressed; exact for a volume]",
)
@bundled(
    "goal",
    "jobs.compressions.CompressionGoal",
    max_loss("0.1, or more if OUT would take more than 6 MB"),
    max_size,
)
@truth("of --cameras")
@min_psnr
@samples
@click.option("--title", help="Title of the page.  [default: the name of IN without its extension]")
@click.option(
    "--background",
    type=Background(),
    default="transparent",
    show_default=True,
    help="Background: white, black, R,G,B, or transparent (light or dark, following the browser's setting).",
)
@click.option(
    "--lookup",
    type=click.Choice(["nearest", "trilinear"]),
    default="nearest",
    show_default=True,
    help="Lookup that the page opens with, which can be switched there. nearest: constant values in each cell; "
    "trilinear: values interpolated between cell centres.",
)
@mesh_options
@click.option("--stage1", type=Reads(), help="Stage-1 folder that the atlas IN was baked from, to show both.")
@click.option(
    "--cameras",
    metavar="CAPTURE",
    type=Capture(),
    help=f"Cameras to look from: {CAPTURE}.  [default: the front, turning]",
)
@click.option(
    "--photographs",
    is_flag=True,
    help="Also store the photographs of --cameras, 480 pixels wide, to show them over the scene.",
)
@device_option
@function_options()
@grid_options()
@console_options
def view(source: Source, target: Target | None, console: Console, **options: Any) -> None:
    """Make a web page that shows a scene.

    Writes OUT, a single HTML file that shows IN in any browser and that you can mail.

    IN is a PlenOctree, an octree, a volume, a lattice, splats, a mesh, or a folder with a mesh: nerf2mesh's stage 1 or
    an atlas. Without OUT, writes a temporary page and opens it in the browser.

    \b
      nerfbake view chair.npz
      nerfbake view chair.npz chair.html
      nerfbake view chair.npz small.html --max-size 1MB --title "A chair"
      nerfbake view chair.svo.pb chair.html --data exact --cameras transforms.json
      nerfbake view phone.npz phone.html --cameras phone --photographs
      nerfbake view chair.npz room.html --mesh room.glb
      nerfbake view atlas_64 atlas.html --stage1 mesh_stage1
      nerfbake view scene.ply scene.html --as splats
    """

    if options.pop("shown_as") == "splats":
        from nerfbake.jobs.splat_pages import view_splats

        without_effect(*_OF_FIELDS, here="with --as splats", allowed="with --as field")
        view_splats(source, target, steps=console, **{name: options[name] for name in options.keys() - _OF_FIELDS})
        return

    from nerfbake.jobs.pages import view_file

    if options["data"] == "exact":
        here = "with --data exact"
        without_effect("max_loss", "max_size", "truth", here=here, allowed="with --data compressed")
    if options["truth"] is None and options["min_psnr"] is None:
        allowed = "--samples with --truth or --min-psnr"
        without_effect("samples", here="without --truth or --min-psnr", allowed=allowed)
    view_file(source, target, steps=console, **options)
