"""`nerfbake mesh`: turn a field into a textured mesh."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import click

from nerfbake import io
from nerfbake.cli.function_params import function_options
from nerfbake.cli.params import (
    Box,
    ParamType,
    as_json,
    console_options,
    parse_count,
    seed,
    source_argument,
    without_effect,
)
from nerfbake.cli.paths import MeshOutput, Reads
from nerfbake.cli.picture_params import held_out_psnr, training_picture_options
from nerfbake.console import Console
from nerfbake.jobs.files import Source, Target

if TYPE_CHECKING:
    from nerfbake.jobs.meshes import MeshResult
    from nerfbake.stages.views_to_error import ViewError


class TriangleCounts(ParamType[tuple[int, ...]]):
    """Numbers of triangles: 50000, 50k or 1.5M; several where `several` is set."""

    name = "N"

    def __init__(self, *, several: bool = False) -> None:
        self._several = several
        self.name = "N,N,..." if several else "N"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[int, ...]:
        if isinstance(value, tuple):
            return value
        words = value.split(",") if self._several else [value]
        found = tuple(map(parse_count, words))
        if not all(4 <= count <= 100_000_000 for count in found):
            allowed = "20k,5k,..." if self._several else "20k, 20000, ..."
            self.fail(f"{value!r} is not a number of triangles; allowed: {allowed}, each 4 or more", param, ctx)
        return found


texture_option = click.option(
    "--texture",
    metavar="EDGE",
    type=click.IntRange(16, 8192),
    default=2048,
    show_default=True,
    help="Texels along an edge of the mesh's texture.",
)


@click.command()
@source_argument
@click.argument("target", metavar="OUT", type=MeshOutput())
@click.option("--force", is_flag=True, help="Replace OUT, and the files beside it, if they exist.")
@training_picture_options("Photographs for the texture", "jobs.mesh_options.MeshViews")
@click.option(
    "--triangles",
    type=TriangleCounts(),
    default="50k",
    show_default=True,
    help="Largest number of triangles, for example 20k.",
)
@click.option(
    "--lods",
    type=TriangleCounts(several=True),
    help="Levels of detail in one .glb (MSFT_lod): numbers of triangles, the largest first. Each level has a texture "
    "of its own, half as wide as that of the level before. Viewers without the extension show the first.",
)
@texture_option
@click.option(
    "--box",
    type=Box(),
    help="Two opposite corners of a box in world coordinates. What is outside is left out.",
)
@click.option("--largest", is_flag=True, help="Keep the largest connected part alone.")
@click.option(
    "--in-up",
    type=click.Choice(["y", "z"]),
    help="For a .glb or USD: up axis of IN, which is rotated to y, the up axis of these files.  [default: z]",
)
@click.option(
    "--lit",
    is_flag=True,
    help="Write a rough material with normals, which viewers light, to a .glb. Without it the colours are shown as "
    "they are (KHR_materials_unlit).",
)
@click.option(
    "--environment",
    type=Reads(),
    help="Equirectangular map (.hdr) of the light of the photographs, z up. Estimates roughness and specular strength "
    "of 8 materials, and writes them to a .glb (KHR_materials_specular), with the albedo as its texture.",
)
@click.option(
    "--image",
    type=click.Choice(["png", "jpeg", "webp"]),
    help="Coding of the texture; webp only in a .glb (EXT_texture_webp).  [default: jpeg, in a folder png]",
)
@held_out_psnr
@function_options("box")
@seed
@as_json
@console_options
def mesh(
    source: Source,
    target: str,
    force: bool,
    triangles: tuple[int, ...],
    lods: tuple[int, ...] | None,
    texture: int,
    box: Any,
    largest: bool,
    in_up: Any,
    lit: bool,
    environment: str | None,
    image: Any,
    seed: int,
    as_json: bool,
    console: Console,
    **options: Any,
) -> None:
    """Turn a field into a textured mesh.

    Finds the surface of the PlenOctree, octree, volume, lattice or splats IN, simplifies it, and fits a texture to
    photographs (--views), or to pictures of IN. OUT is a .glb, USD (.usdz, .usdc, .usda), an .obj with its .mtl and
    texture beside it, a .ply with colours at the vertices, or a folder without an extension: nerf2mesh's stage 1, with
    highlights, which `nerfbake atlas`, `view` and `render` take. If IN is such a folder, or MobileNeRF's, its texture
    becomes the mean colour over all directions. Prints PSNR, SSIM and silhouettes of OUT on held-out views.

    \b
      nerfbake mesh chair.npz chair.glb
      nerfbake mesh chair.npz chair.usdz
      nerfbake mesh chair.npz chair_stage1 --views photographs
      nerfbake mesh chair.npz toy.obj --triangles 20k --texture 1024 --min-psnr 28
    """

    from nerfbake.jobs.mesh_options import MeshFile, MeshOptions
    from nerfbake.jobs.meshes import bake_mesh

    if lods is not None:
        without_effect("triangles", here="with --lods, which has its own", allowed="one of them")
    bake_mesh(
        source,
        Target(target, force=force),
        options=MeshOptions(triangles=lods or triangles, texture=texture, box=box, largest=largest, seed=seed),
        file=MeshFile(in_up=in_up, lit=lit, image=image, environment=environment),
        steps=console,
        report=(lambda found: io.print_json(_facts(source, found))) if as_json else None,
        **options,
    )


def _facts(source: Source, found: MeshResult) -> dict[str, Any]:
    quality = found.quality
    plain = quality.diffuse
    rows = zip(quality.views, quality.silhouettes, strict=True)
    return {
        "in": source.path,
        "file": found.path,
        "content": found.content,
        "bytes": found.bytes,
        "triangles": list(found.triangles),
        "psnr": quality.psnr,
        "ssim": None if quality.lit else quality.ssim,
        "iou": quality.iou,
        "worst": None if quality.lit else quality.worst.name,
        "diffuse": None if plain is None else [view._asdict() for view in plain],
        "cpu_seconds": found.worked,
        "views": [{**(_named(view) if quality.lit else view._asdict()), "iou": iou} for view, iou in rows],
        "materials": [each._asdict() for each in found.materials] or None,
    }


def _named(view: ViewError) -> dict[str, str]:
    """The name alone: without light, the errors say nothing about a mesh with materials."""
    return {"name": view.name}
