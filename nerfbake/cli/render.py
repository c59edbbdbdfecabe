"""`nerfbake render`: render pictures of a scene."""

from __future__ import annotations

from collections.abc import Mapping
from functools import wraps
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import click
from click.core import ParameterSource

from nerfbake.cli.function_params import world_option
from nerfbake.cli.params import (
    CAPTURE,
    Command,
    NumberRange,
    ParamType,
    PixelSize,
    bundled,
    console_options,
    device_option,
    grid_options,
    is_whole,
    lookup,
    samples,
    source_argument,
    without_effect,
)
from nerfbake.cli.paths import Capture, DeclaredPaths, Reads, Writes
from nerfbake.console import Console
from nerfbake.jobs.files import Source

if TYPE_CHECKING:
    from nerfbake.jobs.pictures import PictureOutputs, ViewSelection


class Background(ParamType[tuple[float, float, float] | None]):
    """white, black, transparent, or R,G,B in 0..255."""

    name = "colour"
    known: ClassVar = {"white": (1.0, 1.0, 1.0), "black": (0.0, 0.0, 0.0), "transparent": None}

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        if value in self.known:
            return self.known[value]
        parts = value.split(",") if isinstance(value, str) else []
        if len(parts) != 3 or not all(is_whole(part, 0, 255) for part in parts):
            known = ", ".join(self.known)
            self.fail(f"{value!r} is not a colour; allowed: {known}, or R,G,B in 0..255", param, ctx)
        return tuple(int(part) / 255 for part in parts)


class PicturesPath(Writes):
    """A picture with its depth and alpha files, or a folder of pictures."""

    def declare(self, paths: tuple[str, ...], options: Mapping[str, Any]) -> DeclaredPaths:
        from nerfbake.jobs.pictures import PictureOutputs

        pictures = PictureOutputs(out=paths[0], depth=options["depth"], alpha=options["alpha"])
        single = not (options["every"] or options["turntable"])
        return DeclaredPaths(writes=(*paths, *pictures.beside(paths[0])) if single else paths)


def _check_views(shots: ViewSelection) -> None:
    shots.require()
    if shots.turntable or not shots.cameras:
        without_effect("frame", "every", here="without cameras to choose from", allowed="with --cameras")
    if shots.every:
        without_effect("frame", here="with --all", allowed="one of them")


view_options = bundled(
    "shots",
    "jobs.pictures.ViewSelection",
    click.option(
        "--cameras",
        metavar="CAPTURE",
        type=Capture(),
        help=f"Cameras: {CAPTURE}.  [default: an orbit around the scene]",
    ),
    click.option(
        "--frame", type=click.IntRange(min=0), default=0, show_default=True, help="Number of the camera to use, from 0."
    ),
    click.option("--all", "every", is_flag=True, help="Render the views of all cameras."),
    click.option("--turntable", type=click.IntRange(2, 1000), help="Render this many views around the scene."),
    click.option(
        "--size",
        type=PixelSize(),
        help="Picture size in pixels.  [default: that of the cameras; 800x800 for an orbit]",
    ),
    samples,
    world_option,
    check=_check_views,
)
picture_options = bundled(
    "pictures",
    "jobs.pictures.PictureOutputs",
    click.option(
        "--out",
        required=True,
        type=PicturesPath(),
        help="Output: a .png or '-'; for several views a .gif, a .png that shows them all, or a folder.",
    ),
    click.option(
        "--depth",
        type=click.Choice(["png", "npy"]),
        is_flag=False,
        flag_value="png",
        help="Also write NAME.depth.png (16 bits, thousandths of a world unit) or NAME.depth.npy for each picture.",
    ),
    click.option("--alpha", is_flag=True, help="Also write NAME.alpha.png for each picture: white is opaque."),
    click.option("--force", is_flag=True, help="Replace existing files."),
)


def mesh_options(function: Command) -> Command:
    """Add --mesh, --mesh-up and --composite; pass the command `mesh`, a PlacedMesh or None."""

    @click.option(
        "--mesh",
        type=Reads(),
        help="A .glb, .obj, .ply or USD with opaque triangles, in the scene's world coordinates.",
    )
    @click.option(
        "--mesh-up",
        type=click.Choice(["y", "z"]),
        default="y",
        show_default=True,
        help="With --mesh: the axis of the scene that the mesh's y axis maps to. Use z for a .glb from Blender.",
    )
    @click.option(
        "--composite",
        "how",
        type=click.Choice(["stop", "ztest"]),
        default="stop",
        show_default=True,
        help="With --mesh. stop: rays stop at the mesh; ztest: the field covers the mesh where its depth is nearer.",
    )
    @wraps(function)
    def command(
        *args: object, mesh: str | None, mesh_up: Literal["y", "z"], how: Literal["stop", "ztest"], **others: object
    ) -> object:
        from nerfbake.jobs.pictures import PlacedMesh

        if not mesh:
            without_effect("how", "mesh_up", here="without a mesh", allowed="with --mesh")
        return function(*args, mesh=PlacedMesh(path=mesh, up=mesh_up, how=how) if mesh else None, **others)

    return command


@click.command()
@source_argument
@view_options
@picture_options
@click.option(
    "--background",
    type=Background(),
    default="white",
    show_default="white; of a trained field its own",
    help="Background: white, black, transparent or R,G,B.",
)
@lookup
@click.option("--lod", type=click.IntRange(min=0), help="Level of detail at which an octree is rendered.")
@click.option(
    "--transmittance-cut",
    type=NumberRange(0, 1, max_open=True),
    default=1e-4,
    show_default=True,
    help="A ray ends when its transmittance falls below this value. 0.5 makes an opaque cutout.",
)
@mesh_options
@device_option
@grid_options()
@console_options
def render(source: Source, pictures: PictureOutputs, shots: ViewSelection, console: Console, **options: Any) -> None:
    """Render pictures or a turntable.

    Renders the PlenOctree, octree, volume, lattice, trained field, splats or mesh IN as PNG or as an animated GIF. A
    density without colours is rendered grey. A mesh is a .glb, .obj, .ply or USD, a stage-1 folder of nerf2mesh or an
    atlas.

    \b
      nerfbake render chair.npz --out chair.png
      nerfbake render chair.nvdb --out chair.png --lookup trilinear --depth
      nerfbake render smoke.vdb --grid density --in-up y --out smoke.png
      nerfbake render chair.npz --samples 2 --out smooth.png
      nerfbake render chair.npz --turntable 36 --size 400x400 --out chair.gif
      nerfbake render chair.svo.pb --cameras transforms.json --all --out views
      nerfbake render chair.svo.pb --mesh room.glb --out room.png
    """

    from nerfbake.jobs.pictures import render_views

    where = click.get_current_context().get_parameter_source("background")
    if where in (ParameterSource.DEFAULT, ParameterSource.DEFAULT_MAP):
        del options["background"]  # a trained field has its own default
    render_views(source, pictures, shots, steps=console, **options)
