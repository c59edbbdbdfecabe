"""`nerfbake ship`: make the files that other programs need, and say what each loses."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import click

from nerfbake import io
from nerfbake.cli.function_params import function_options
from nerfbake.cli.mesh import TriangleCounts, texture_option
from nerfbake.cli.params import CAPTURE, ParamType, as_json, bundled, console_options, folder_argument, source_argument
from nerfbake.cli.paths import Capture
from nerfbake.cli.picture_params import training_picture_options
from nerfbake.cli.splats import SplatCount
from nerfbake.console import Console
from nerfbake.errors import UsageError
from nerfbake.jobs.files import FolderTarget, Source

if TYPE_CHECKING:
    from nerfbake.scene.shipment import Shipment


class Targets(ParamType[tuple[str, ...]]):
    """Names of those for whom files are made."""

    name = "NAME,..."

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[str, ...]:
        from nerfbake.jobs.shipping_list import require_targets

        names = tuple(dict.fromkeys(name.strip() for name in str(value).split(",") if name.strip()))
        try:
            require_targets(names)
        except UsageError as error:
            self.fail(error.line, param, ctx)
        return names


@click.command()
@source_argument
@folder_argument()
@click.option(
    "--for",
    "targets",
    type=Targets(),
    required=True,
    help="Who gets the files: some of blender, web, ios, unity, omniverse, archive, separated by commas.",
)
@bundled(
    "options",
    "jobs.shipments.ShipmentOptions",
    click.option(
        "--count",
        "splats",
        type=SplatCount(),
        help="Largest number of splats, for example 150k.  [default: 150k; all splats of IN]",
    ),
    click.option(
        "--triangles",
        type=TriangleCounts(),
        default="50k",
        show_default=True,
        callback=lambda ctx, param, value: value[0],
        help="Largest number of triangles of the mesh, for example 20k.",
    ),
    texture_option,
)
@training_picture_options("Photographs that mesh and splats are fitted to", "jobs.shipments.ShippedViews")
@click.option(
    "--cameras",
    metavar="CAPTURE",
    type=Capture(),
    help=f"Views that the files are judged on: {CAPTURE}.  [default: 8 views around IN]",
)
@function_options()
@as_json
@console_options
def ship(source: Source, target: FolderTarget, as_json: bool, console: Console, **options: Any) -> None:
    """Make files for others, with a receipt.

    Writes the files that Blender, web pages, iPhones, Unity, Omniverse or an archive need of the scene IN to OUT_DIR.
    Each is read back and compared with IN. report.html shows pictures beside each other, PSNR, the worst view, sizes
    and seconds, and which programs in which version read the file; report.json has the same for scripts.

    \b
      nerfbake ship chair.npz out --for blender,web
      nerfbake ship chair.npz out --for ios --views photographs --triangles 20k
      nerfbake ship scene.spz out --for web,archive --count 100k
      nerfbake ship chair.npz out --for blender,web,ios,unity,omniverse,archive --json
    """

    from nerfbake.jobs.shipments import ship_file

    def report(found: Shipment) -> None:
        if as_json:
            io.print_json(found.facts)

    ship_file(source, target, steps=console, report=report, **options)
