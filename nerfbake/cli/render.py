"""`nerfbake render`: pictures of a scene."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar, Literal

import click

import nerfbake
from nerfbake import catalog, io
from nerfbake.cli.params import CAPTURE, Input, PixelSize, reads, speaks, without_effect
from nerfbake.cli.volumes import Choice, chooses_grids
from nerfbake.cli.words import Words


class Background(click.ParamType[tuple[float, float, float] | None]):
    """white, black, transparent, or R,G,B in 0..255."""

    name = "colour"
    known: ClassVar = {"white": (1.0, 1.0, 1.0), "black": (0.0, 0.0, 0.0), "transparent": None}

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        if value in self.known:
            return self.known[value]
        parts = value.split(",") if isinstance(value, str) else []
        if len(parts) != 3 or not all(part.isdecimal() and int(part) < 256 for part in parts):
            self.fail(f"{value!r} is no colour; allowed: white, black, transparent, or R,G,B in 0..255", param, ctx)
        return tuple(int(part) / 255 for part in parts)


@click.command()
@reads
@click.option("--cameras", metavar="CAPTURE", help=f"The cameras: {CAPTURE}.  [default: an orbit around the scene]")
@click.option("--frame", type=click.IntRange(min=0), default=0, show_default=True, help="The camera to use, from 0.")
@click.option("--all", "every", is_flag=True, help="Render the views of all cameras.")
@click.option("--turntable", type=click.IntRange(2, 1000), help="Render this many views around the scene.")
@click.option("--size", type=PixelSize(), help="Size in pixels.  [default: the cameras', 800x800 for an orbit]")
@click.option(
    "--out", required=True, type=click.Path(), help="A .png or '-'; for several views a .gif, a .png sheet or a folder."
)
@click.option(
    "--background", type=Background(), default="white", show_default=True, help="white, black, transparent or R,G,B."
)
@click.option(
    "--depth",
    type=click.Choice(["png", "npy"]),
    is_flag=False,
    flag_value="png",
    help="Write NAME.depth.png beside each picture (16 bits, thousandths of a world unit), or NAME.depth.npy.",
)
@click.option("--alpha", is_flag=True, help="Write NAME.alpha.png beside each picture: white is opaque.")
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
    type=click.FloatRange(0, 1, max_open=True),
    default=1e-4,
    show_default=True,
    help="A ray ends where less than this share of light is left; 0.5 makes an opaque cutout.",
)
@click.option("--mesh", type=click.Path(), help="An .obj or .glb of opaque triangles in the scene's own world.")
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
@chooses_grids
@click.option("--force", is_flag=True, help="Replace files that exist.")
@speaks
def render(
    source: Input,
    choice: Choice,
    cameras: str | None,
    frame: int,
    every: bool,
    turntable: int | None,
    size: tuple[int, int] | None,
    out: str,
    depth: str | None,
    alpha: bool,
    lod: int | None,
    mesh: str | None,
    mesh_up: Literal["y", "z"],
    how: str,
    force: bool,
    words: Words,
    **options: Any,
) -> None:
    """Render the PlenOctree, octree or volume IN as PNG, or as a moving GIF. A density without colours is grey.

    \b
      nerfbake render chair.npz --out chair.png
      nerfbake render chair.nvdb --out chair.png --lookup trilinear --depth
      nerfbake render smoke.vdb --grid density --up y --out smoke.png
      nerfbake render chair.npz --turntable 36 --size 400x400 --out chair.gif
      nerfbake render chair.svo.pb --cameras transforms.json --all --out views
      nerfbake render chair.svo.pb --mesh room.glb --out room.png
    """
    if turntable and cameras:
        raise click.UsageError("--turntable goes around the scene; allowed: it or --cameras")
    if turntable or not cameras:
        without_effect("frame", "every", here="without cameras to choose from", allowed="with --cameras")
    if every:
        without_effect("frame", here="with --all", allowed="one of them")
    if not mesh:
        without_effect("how", "mesh_up", here="without a mesh", allowed="with --mesh")
    several = every or turntable is not None
    if several and out == io.STREAM:
        raise click.UsageError("stdout takes one picture; allowed for several: a .gif, a .png or a folder")
    together = next((kind for kind in ("Animation", "Image") if several and catalog.is_ending(out, kind)), None)
    if (depth or alpha) and (together or out == io.STREAM):
        raise click.UsageError("--depth and --alpha write files beside a picture; allowed: a .png of one, or a folder")
    if together or not several:
        io.format_for(out, together or "Image")
        for path in (out, *_beside(out, depth, alpha)):
            io.require_absent(path, force=force)
    others = () if lod is not None else (nerfbake.N3Tree, nerfbake.Volume)
    scene = choice.of(words, source, source.read(words, *others, nerfbake.SparseVoxelOctree))
    if lod is not None:
        with source.blamed(words, f"cutting at level {lod}"):
            scene = nerfbake.cut_octree(scene, level=lod)
    with source.blamed(words, "building the field"):
        field = nerfbake.build_field(scene)
    views = source.views(words, field, cameras, size, frames=turntable or 1, edge=800).cameras
    chosen = views if several else views[frame : frame + 1]
    if not chosen:
        raise click.UsageError(f"--frame is {frame}; allowed: 0 to {len(views) - 1}")
    with io.blame(cameras or io.reading_name(source.path)):
        nerfbake.Cameras(chosen).require_covered()
    paths = [str(Path(out) / f"{view.name}.png") if several else out for view in chosen]
    if not together:
        io.require_room([target for path in paths for target in (path, *_beside(path, depth, alpha))], force=force)
    picture: Callable[..., Any] = nerfbake.render_field
    if mesh:
        picture = nerfbake.render_field_and_meshes
        options |= {"meshes": io.load(mesh, nerfbake.Meshes).with_up(mesh_up), "how": how}
    if together:
        with io.blame(out):
            nerfbake.Cameras(chosen).require_memory()
    images = []
    for view, path in zip(chosen, paths, strict=True):
        with source.blamed(words, f"rendering {view.name}"):
            image = picture(field, camera=view, **options)
        if together:
            images.append(image)
            continue
        io.save(path, image, force=force, parents=several)
        for beside in _beside(path, depth, alpha):
            plane = image.mask if beside.endswith(".alpha.png") else nerfbake.Depth(image.depth)
            io.save(beside, plane, force=force)
        words.say(f"{path}: {image}")
    if together:
        with words.phase(f"writing {out}"), io.blame(out):
            whole = nerfbake.Animation(tuple(images)) if together == "Animation" else nerfbake.Image.tiled(images)
            written = io.save(out, whole, force=force)
        words.say(f"{out}: {whole}, {written:,} bytes")


def _beside(path: str, depth: str | None, alpha: bool) -> list[str]:
    stem = path.removesuffix(".png")
    return [f"{stem}.depth.{depth}"] * bool(depth) + [f"{stem}.alpha.png"] * alpha
