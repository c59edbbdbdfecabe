"""`nerfbake atlas`: nerf2mesh's specular MLP to octahedral maps."""

from __future__ import annotations

from typing import Any

import click

from nerfbake import io
from nerfbake.cli.params import as_json, bakes_stage1, judges, seed, speaks, without_effect
from nerfbake.cli.words import Words
from nerfbake.jobs.atlases import bake_atlas
from nerfbake.jobs.files import FolderTarget, Stage1Source


@click.command()
@bakes_stage1
@click.option(
    "--method",
    type=click.Choice(["kmeans", "affine", "grid"]),
    default="kmeans",
    show_default=True,
    help="kmeans: one map for each cluster of colours; affine: four maps for each, which follow the colour; "
    "grid: maps at the nodes of a grid in colour space.",
)
@click.option(
    "--clusters", type=click.IntRange(min=1), default=64, show_default=True, help="Clusters, for kmeans and affine."
)
@click.option(
    "--nodes", type=click.IntRange(2, 16), default=7, show_default=True, help="Nodes along each axis, for grid."
)
@click.option(
    "--map-size", type=click.IntRange(2, 1024), default=64, show_default=True, help="Texels along each edge of a map."
)
@click.option(
    "--directions",
    type=click.IntRange(1, 4096),
    default=100,
    show_default=True,
    help="How many view directions the MLP is asked in.",
)
@click.option(
    "--direction-set",
    type=click.Choice(["fibonacci", "cameras"]),
    default="fibonacci",
    show_default=True,
    help="fibonacci: all directions count the same; cameras: as often as the cameras of --transforms look along them.",
)
@click.option(
    "--centres",
    type=click.Choice(["snapped", "mean"]),
    default="snapped",
    show_default=True,
    help="For kmeans, what a map shows: one colour of its cluster, or the mean of all of them.",
)
@click.option(
    "--border",
    type=click.IntRange(min=0),
    default=1,
    show_default=True,
    help="Width of the gutter around a map, in texels.",
)
@click.option(
    "--up",
    type=click.Choice(["y", "z"]),
    default="y",
    show_default=True,
    help="The axis that points up in the mesh. z: nodes of scene.glb turn it to y, and Blender turns it back.",
)
@seed
@judges
@as_json
@speaks
def atlas(source: Stage1Source, target: FolderTarget, as_json: bool, words: Words, **options: Any) -> None:
    """Bake nerf2mesh highlights into octahedral maps.

    Bakes the specular MLP of a nerf2mesh stage-1 folder into octahedral maps, and writes them to OUT_DIR.

    \b
      nerfbake atlas mesh_stage1 atlas --clusters 256 --min-psnr 40
      nerfbake atlas atlas --feature feat1_0.jpg --mlp mlp.json --method affine
    """
    method, even = options["method"], options["direction_set"] == "fibonacci"
    if method != "grid":
        without_effect("nodes", here=f"with --method {method}", allowed="--nodes with --method grid")
    if method == "grid":
        without_effect("clusters", "seed", here="with --method grid", allowed="--nodes")
    if method != "kmeans":
        without_effect("centres", here=f"with --method {method}", allowed="--centres with --method kmeans")
    if even:
        without_effect("transforms", here="where all directions count the same", allowed="--direction-set cameras")
    report = io.print_json if as_json else None
    bake_atlas(source, target, steps=words, report=report, **options)
