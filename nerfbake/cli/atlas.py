"""`nerfbake atlas`: bake nerf2mesh's specular MLP into octahedral maps."""

from __future__ import annotations

import functools
from typing import Any

import click

from nerfbake import io
from nerfbake.cli.params import (
    Command,
    as_json,
    console_options,
    max_memory,
    seed,
    surface_budget_options,
    without_effect,
)
from nerfbake.cli.paths import Reads, Stage1AndFolder
from nerfbake.console import Console
from nerfbake.jobs.files import FolderTarget, Stage1Source


def _arguments(function: Command) -> Command:
    """Add [STAGE1_DIR] OUT_DIR, --feature, --mlp, --transforms and --force; pass the command `source` and `target`."""

    @click.argument("folders", metavar="[STAGE1_DIR] OUT_DIR", nargs=-1, type=Stage1AndFolder())
    @click.option(
        "--feature", "features", multiple=True, type=Reads(), help="Feature texture. Repeat for each cascade."
    )
    @click.option(
        "--mlp", type=Reads(), help="The mlp.json for --feature. The two options together replace STAGE1_DIR."
    )
    @click.option(
        "--transforms", type=Reads(), help="Training cameras: a transforms.json in the mesh's world coordinates."
    )
    @click.option("--force", is_flag=True, help="Replace OUT_DIR if nerfbake wrote all that it contains.")
    @max_memory
    @functools.wraps(function)
    def command(
        *args: object,
        folders: tuple[str, ...],
        features: tuple[str, ...],
        mlp: str | None,
        transforms: str | None,
        force: bool,
        **others: object,
    ) -> object:
        if bool(features) != bool(mlp) or len(folders) != 2 - bool(mlp):
            raise click.UsageError("give STAGE1_DIR and OUT_DIR, or OUT_DIR with --feature and --mlp")
        source = Stage1Source("" if mlp else folders[0], features, mlp, transforms)
        return function(*args, source=source, target=FolderTarget(folders[-1], force), **others)

    return command


@click.command()
@_arguments
@click.option(
    "--method",
    type=click.Choice(["kmeans", "affine", "grid"]),
    default="kmeans",
    show_default=True,
    help="kmeans: one map per cluster of colours; affine: four maps per cluster, a base and three slopes that follow "
    "the colour; grid: maps at the nodes of a grid in colour space.",
)
@click.option(
    "--clusters",
    type=click.IntRange(min=1),
    default=64,
    show_default=True,
    help="Number of clusters, for kmeans and affine.",
)
@click.option(
    "--nodes",
    type=click.IntRange(2, 16),
    default=7,
    show_default=True,
    help="Nodes along each axis of the grid, for grid.",
)
@click.option(
    "--map-size", type=click.IntRange(2, 1024), default=64, show_default=True, help="Texels along each edge of a map."
)
@click.option(
    "--directions",
    type=click.IntRange(1, 4096),
    default=100,
    show_default=True,
    help="Number of view directions in which the MLP is evaluated.",
)
@click.option(
    "--direction-set",
    type=click.Choice(["fibonacci", "cameras"]),
    default="fibonacci",
    show_default=True,
    help="Weights of the directions. fibonacci: all equal; cameras: how often the cameras of --transforms look along "
    "each.",
)
@click.option(
    "--centres",
    type=click.Choice(["snapped", "mean"]),
    default="snapped",
    show_default=True,
    help="For kmeans. snapped: a map shows one colour of its cluster; mean: it shows the mean of all of them.",
)
@click.option(
    "--border",
    type=click.IntRange(min=0),
    default=1,
    show_default=True,
    help="Width of the gutter around each map, in texels.",
)
@click.option(
    "--in-up",
    type=click.Choice(["y", "z"]),
    default="y",
    show_default=True,
    help="Up axis of the mesh. z: the nodes of scene.glb rotate z to y, and Blender rotates it back.",
)
@seed
@surface_budget_options
@as_json
@console_options
def atlas(source: Stage1Source, target: FolderTarget, as_json: bool, console: Console, **options: Any) -> None:
    """Bake nerf2mesh highlights into octahedral maps.

    Bakes the specular MLP of the nerf2mesh stage-1 folder STAGE1_DIR into octahedral maps, and writes them to OUT_DIR.

    \b
      nerfbake atlas mesh_stage1 atlas --clusters 256 --min-psnr 40
      nerfbake atlas atlas --feature feat1_0.jpg --mlp mlp.json --method affine
    """

    from nerfbake.jobs.atlases import bake_atlas_folder

    method, even = options["method"], options["direction_set"] == "fibonacci"
    if method != "grid":
        without_effect("nodes", here=f"with --method {method}", allowed="--nodes with --method grid")
    if method == "grid":
        without_effect("clusters", "seed", here="with --method grid", allowed="--nodes")
    if method != "kmeans":
        without_effect("centres", here=f"with --method {method}", allowed="--centres with --method kmeans")
    if even:
        without_effect("transforms", here="with --direction-set fibonacci", allowed="--direction-set cameras")
    report = io.print_json if as_json else None
    bake_atlas_folder(source, target, steps=console, report=report, **options)
