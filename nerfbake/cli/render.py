"""`nerfbake render`: pictures of a scene."""

from __future__ import annotations

from collections.abc import Mapping
from functools import wraps
from typing import Any, ClassVar, Literal

import click

from nerfbake.cli.params import CAPTURE, Command, NumberRange, PixelSize, reads, samples, speaks, without_effect
from nerfbake.cli.paths import Capture, Declared, Reads, Writes
from nerfbake.cli.volumes import chooses_grids
from nerfbake.cli.words import Words
from nerfbake.jobs.files import Source
from nerfbake.jobs.pictures import Pictures, PlacedMesh, Shots, render_views


class Background(click.ParamType[tuple[float, float, float] | None]):
    """white, black, transparent, or R,G,B in 0..255."""

    name = "colour"
    known: ClassVar = {"white": (1.0, 1.0, 1.0), "black": (0.0, 0.0, 0.0), "transparent": None}

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        if value in self.known:
            return self.known[value]
        parts = value.split(",") if isinstance(value, str) else []
        if len(parts) != 3 or not all(part.isdecimal() and int(part) < 256 for part in parts):
            known = ", ".join(self.known)
            self.fail(f"{value!r} is no colour; allowed: {known}, or R,G,B in 0..255", param, ctx)
        return tuple(int(part) / 255 for part in parts)


class PicturesPath(Writes):
    """A picture and what stands beside it, or a folder of pictures."""

    def declare(self, paths: tuple[str, ...], options: Mapping[str, Any]) -> Declared:
        pictures, single = (
            Pictures(paths[0], options["depth"], options["alpha"]),
            not (options["every"] or options["turntable"]),
        )
        return Declared(writes=(*paths, *pictures.beside(paths[0])) if single else paths)


def takes_shots(function: Command) -> Command:
    """Adds --cameras, --frame, --all, --turntable, --size and --samples; the command gets `shots`."""

    @click.option(
        "--cameras",
        metavar="CAPTURE",
        type=Capture(),
        help=f"The cameras: {CAPTURE}.  [default: an orbit around the scene]",
    )
    @click.option(
        "--frame", type=click.IntRange(min=0), default=0, show_default=True, help="The camera to use, from 0."
    )
    @click.option("--all", "every", is_flag=True, help="Render the views of all cameras.")
    @click.option("--turntable", type=click.IntRange(2, 1000), help="Render this many views around the scene.")
    @click.option("--size", type=PixelSize(), help="Size in pixels.  [default: the cameras', 800x800 for an orbit]")
    @samples
    @wraps(function)
    def command(
        *args: Any,
        cameras: str | None,
        frame: int,
        every: bool,
        turntable: int | None,
        size: Any,
        samples: int | None,
        **others: Any,
    ) -> Any:
        shots = Shots(cameras, frame, every, turntable, size, samples)
        shots.require()
        if turntable or not cameras:
            without_effect("frame", "every", here="without cameras to choose from", allowed="with --cameras")
        if every:
            without_effect("frame", here="with --all", allowed="one of them")
        return function(*args, shots=shots, **others)

    return command


def writes_pictures(function: Command) -> Command:
    """Adds --out, --depth, --alpha and --force; the command gets `pictures`."""

    @click.option(
        "--out",
        required=True,
        type=PicturesPath(),
        help="A .png or '-'; for several views a .gif, a .png sheet or a folder.",
    )
    @click.option(
        "--depth",
        type=click.Choice(["png", "npy"]),
        is_flag=False,
        flag_value="png",
        help="Write NAME.depth.png beside each picture (16 bits, thousandths of a world unit), or NAME.depth.npy.",
    )
    @click.option("--alpha", is_flag=True, help="Write NAME.alpha.png beside each picture: white is opaque.")
    @click.option("--force", is_flag=True, help="Replace files that exist.")
    @wraps(function)
    def command(
        *args: Any, out: str, depth: Literal["png", "npy"] | None, alpha: bool, force: bool, **others: Any
    ) -> Any:
        return function(*args, pictures=Pictures(out, depth, alpha, force), **others)

    return command


def places_mesh(function: Command) -> Command:
    """Adds --mesh, --mesh-up and --composite; the command gets `mesh`, a PlacedMesh or None."""

    @click.option("--mesh", type=Reads(), help="An .obj or .glb of opaque triangles in the scene's own world.")
    @click.option(
        "--mesh-up",
        type=click.Choice(["y", "z"]),
        default="y",
        show_default=True,
        help="With --mesh: the axis of the scene that the mesh's y becomes; z is what Blender makes of a .glb.",
    )
    @click.option(
        "--composite",
        "how",
        type=click.Choice(["stop", "ztest"]),
        default="stop",
        show_default=True,
        help="With --mesh. stop: rays stop at it; ztest: the field lies over it where the field's depth is nearer.",
    )
    @wraps(function)
    def command(
        *args: Any, mesh: str | None, mesh_up: Literal["y", "z"], how: Literal["stop", "ztest"], **others: Any
    ) -> Any:
        if not mesh:
            without_effect("how", "mesh_up", here="without a mesh", allowed="with --mesh")
        return function(*args, mesh=PlacedMesh(mesh, mesh_up, how) if mesh else None, **others)

    return command


@click.command()
@reads
@takes_shots
@writes_pictures
@click.option(
    "--background", type=Background(), default="white", show_default=True, help="white, black, transparent or R,G,B."
)
@click.option(
    "--lookup",
    type=click.Choice(["nearest", "trilinear"]),
    default="nearest",
    show_default=True,
    help="nearest: cells as they are; trilinear: values interpolated between their centres.",
)
@click.option("--lod", type=click.IntRange(min=0), help="The level at which an octree is shown.")
@click.option(
    "--transmittance-cut",
    type=NumberRange(0, 1, max_open=True),
    default=1e-4,
    show_default=True,
    help="A ray ends where less than this share of light is left; 0.5 makes an opaque cutout.",
)
@places_mesh
@chooses_grids
@speaks
def render(source: Source, pictures: Pictures, shots: Shots, words: Words, **options: Any) -> None:
    """Render pictures or a turntable.

    Renders the PlenOctree, octree or volume IN as PNG, or as a moving GIF. A density without colours is grey.

    \b
      nerfbake render chair.npz --out chair.png
      nerfbake render chair.nvdb --out chair.png --lookup trilinear --depth
      nerfbake render smoke.vdb --grid density --up y --out smoke.png
      nerfbake render chair.npz --samples 2 --out smooth.png
      nerfbake render chair.npz --turntable 36 --size 400x400 --out chair.gif
      nerfbake render chair.svo.pb --cameras transforms.json --all --out views
      nerfbake render chair.svo.pb --mesh room.glb --out room.png
    """
    render_views(source, pictures, shots, steps=words, **options)
