"""`nerfbake convert`: write an octree, a volume, splats or cameras in another format or layout."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import click

from nerfbake.catalog import cameras_to_write, folder_of_key, is_ending
from nerfbake.cli.function_params import function_options
from nerfbake.cli.params import (
    ALL,
    ParamType,
    budget_options,
    codec_option,
    console_options,
    grid_options,
    octree_target_argument,
    source_argument,
    without_effect,
)
from nerfbake.cli.splat_files import splat_file_options
from nerfbake.cli.world_params import world_options
from nerfbake.console import Console
from nerfbake.jobs.files import Source, Target

if TYPE_CHECKING:
    from nerfbake.jobs.world import WorldOptions

# Names of the options of a trained field, and of --min-psnr.
_OF_VOXELS = ("resolution", "box", "basis", "scenery", "world", "seen_from", "min_psnr")
# Names of the options of octrees, volumes and files of splats.
_OF_FILES = ("layout", "no_child", "grids", "in_up", "codec", "half", "small", "profile", "voxel_type")


class VariantNames(ParamType[list[str]]):
    """Names, separated by commas."""

    name = "NAMES"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> list[str]:
        return str(value).split(",")


@click.command()
@source_argument
@octree_target_argument("N3Tree", "Volume", "Splats", "Cameras")
@click.option(
    "--layout",
    type=click.Choice(["full", "compact"]),
    help="full: child slots for every node; compact: no child slots on the last level.  [default: as in IN]",
)
@grid_options(splats=True)
@codec_option
@click.option("--half", is_flag=True, help="Store a volume, or all but the centres of splats (USD), in float16.")
@splat_file_options
@click.option(
    "--variants",
    type=VariantNames(),
    help="Representations of the scene IN in one stage of USD, separated by commas: splats, mesh, volume. Viewers show "
    "the first, and let their users choose.",
)
@function_options()
@world_options("as in IN; cameras only")
@budget_options
@console_options
def convert(
    source: Source,
    target: Target,
    console: Console,
    variants: list[str] | None,
    world: WorldOptions,
    **options: Any,
) -> None:
    """Convert between formats, and report any loss.

    Writes the octree IN in another format or layout, or the volume IN as .vdb, .nvdb or .vdb.npz, without loss.
    A field that another program trained becomes a PlenOctree (.npz) or an octree. Prints the loss against its own
    pictures.
    Gaussian splats become .ply, .spz, .sog, .glb or USD (.usda, .usdc, .usdz), or the folder of a .sog if OUT is
    FOLDER/meta.json. Prints the largest and the median loss. --in-up names the axis of their world, as `info` describes
    it, that points up: they are rotated so that it points up in OUT, too.

    A volume, or another scene as in `nerfbake svo`, becomes an octree, too. That of a volume is complete if `nerfbake
    vdb` wrote the volume with the grids `index` or `density,sh`. From any other fog volume the octree gets the density
    only. With --grid all, each grid of a volume becomes a file: smoke.density.nvdb, ... A stage of USD (.usda, .usdc)
    gets its grids in a .vdb beside it.

    With --variants, the field or the splats IN become a stage of USD that has them as splats, as a mesh and as a volume
    (not in a package), each made as by `nerfbake splats`, `mesh` and `vdb`, with its loss in its metadata.

    Cameras of any tool that `info` describes become nerfstudio's transforms.json, a stage of USD (--in-up: the axis of
    their world that points up), with --to colmap a folder with the text of a COLMAP model, and with --to 3dgs
    cameras.json of 3D Gaussian Splatting.

    \b
      nerfbake convert chair.svo.pb chair.svo.npz
      nerfbake convert chair.svo.pb - --to svo.npz --layout compact > chair.svo.npz
      nerfbake convert chair.nvdb chair.svo.pb
      nerfbake convert smoke.vdb smoke.nvdb --grid density
      nerfbake convert smoke.vdb smoke.nvdb --grid all
      nerfbake convert smoke.vdb smoke.svo.npz --grid density --in-up y
      nerfbake convert step-000029999.ckpt fox.npz --basis SH16
      nerfbake convert scene.ply scene.spz
      nerfbake convert scene.ply scene.glb --in-up z
      nerfbake convert scene.ply scene.usdz --half
      nerfbake convert scene.ply scene/meta.json
      nerfbake convert chair.npz chair.usdz --variants splats,mesh
      nerfbake convert chair.npz chair.usda --variants mesh,splats,volume
      nerfbake convert upside_down.spz scene.spz --in-axes RDF --spz-version 3
      nerfbake convert cameras.xml transforms.json
      nerfbake convert cameras.xml sparse/0 --to colmap
      nerfbake convert flight/transforms.json metres.json --scale gps --ground
    """

    if variants is not None:
        from nerfbake.jobs.variants import bake_variants

        without_effect(*_OF_FILES, "min_psnr", here="with --variants", allowed="no --variants")
        bake_variants(source, target, variants, functions=options["functions"], steps=console)
        return
    if _is_of_cameras(target):
        _refuse_options()
        from nerfbake.jobs.cameras import convert_cameras

        convert_cameras(source, target, world=world, steps=console)
        return
    without_effect("scale", "ground", here="without cameras", allowed="them for cameras")
    from nerfbake.jobs.conversions import convert_file, split_volume

    if options["choice"].grids != (ALL,):
        convert_file(source, target, steps=console, **options)
        return
    here = "with --grid all, which writes volumes"
    without_effect("layout", "no_child", *_OF_VOXELS, here=here, allowed="no --grid all")
    split_volume(
        source, target, in_up=options["choice"].in_up, codec=options["codec"], half=options["half"], steps=console
    )


def _is_of_cameras(target: Target) -> bool:
    """True if OUT can only be cameras. Their formats and those of splats share extensions and names of files."""
    if is_ending(target.ending, "Splats") or (target.to is None and folder_of_key(target.path)):
        return False
    return cameras_to_write(target.ending, target.to) is not None


def _refuse_options() -> None:
    """Raise UsageError for the options of other scenes."""
    without_effect(*_OF_FILES, *_OF_VOXELS, here="on cameras", allowed="--to and --force")
