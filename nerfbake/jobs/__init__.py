"""Jobs: what a command does, from files to files, for Python, for batches and for the command line.

    from nerfbake.jobs import Budget, Shots, bake_octree, render_views

    bake_octree("chair.npz", "chair.svo.pb", resolution=128, budget=Budget(min_psnr=30))
    render_views("chair.svo.pb", "turn.gif", Shots(turntable=36, size=(400, 400)))

A job tells wrong arguments before any work is done, writes a file whole or not at all, and raises NerfbakeError with
the exit code that the command would end with. It is silent unless `steps` says otherwise, and takes no more memory than
the memory_limit() around it allows. Names are imported on first use.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from nerfbake.jobs.atlases import bake_atlas as bake_atlas
    from nerfbake.jobs.atlases import measure_atlas as measure_atlas
    from nerfbake.jobs.batches import Batch as Batch
    from nerfbake.jobs.batches import Item as Item
    from nerfbake.jobs.batches import Run as Run
    from nerfbake.jobs.batches import run_batch as run_batch
    from nerfbake.jobs.budgets import Budget as Budget
    from nerfbake.jobs.budgets import judge as judge
    from nerfbake.jobs.comparisons import Compared as Compared
    from nerfbake.jobs.comparisons import Limits as Limits
    from nerfbake.jobs.comparisons import Pages as Pages
    from nerfbake.jobs.comparisons import Seen as Seen
    from nerfbake.jobs.comparisons import compare_files as compare_files
    from nerfbake.jobs.compressions import Goal as Goal
    from nerfbake.jobs.compressions import Photographs as Photographs
    from nerfbake.jobs.compressions import compress_file as compress_file
    from nerfbake.jobs.conversions import convert_file as convert_file
    from nerfbake.jobs.conversions import split_volume as split_volume
    from nerfbake.jobs.descriptions import describe_file as describe_file
    from nerfbake.jobs.files import FolderTarget as FolderTarget
    from nerfbake.jobs.files import Source as Source
    from nerfbake.jobs.files import Stage1Source as Stage1Source
    from nerfbake.jobs.files import Target as Target
    from nerfbake.jobs.fits import Fitted as Fitted
    from nerfbake.jobs.fits import Recipe as Recipe
    from nerfbake.jobs.fits import fit_file as fit_file
    from nerfbake.jobs.fits import fit_scene as fit_scene
    from nerfbake.jobs.grids import Choice as Choice
    from nerfbake.jobs.hulls import bake_hull as bake_hull
    from nerfbake.jobs.lattices import bake_lattice as bake_lattice
    from nerfbake.jobs.octrees import bake_lod as bake_lod
    from nerfbake.jobs.octrees import bake_octree as bake_octree
    from nerfbake.jobs.photographs import Album as Album
    from nerfbake.jobs.pictures import Pictures as Pictures
    from nerfbake.jobs.pictures import PlacedMesh as PlacedMesh
    from nerfbake.jobs.pictures import Shots as Shots
    from nerfbake.jobs.pictures import render_views as render_views
    from nerfbake.jobs.refits import Again as Again
    from nerfbake.jobs.refits import Model as Model
    from nerfbake.jobs.refits import Refitted as Refitted
    from nerfbake.jobs.refits import refit_file as refit_file
    from nerfbake.jobs.samples import write_sample_capture as write_sample_capture
    from nerfbake.jobs.samples import write_sample_n3tree as write_sample_n3tree
    from nerfbake.jobs.samples import write_sample_stage1 as write_sample_stage1
    from nerfbake.jobs.shaders import write_shaders as write_shaders
    from nerfbake.jobs.steps import Steps as Steps
    from nerfbake.jobs.viewing import view_file as view_file
    from nerfbake.jobs.volumes import bake_volume as bake_volume

JOBS = {
    "bake_atlas": "atlases",
    "bake_hull": "hulls",
    "bake_lattice": "lattices",
    "bake_lod": "octrees",
    "bake_octree": "octrees",
    "bake_volume": "volumes",
    "compare_files": "comparisons",
    "compress_file": "compressions",
    "convert_file": "conversions",
    "split_volume": "conversions",
    "describe_file": "descriptions",
    "fit_file": "fits",
    "fit_scene": "fits",
    "judge": "budgets",
    "measure_atlas": "atlases",
    "refit_file": "refits",
    "render_views": "pictures",
    "run_batch": "batches",
    "view_file": "viewing",
    "write_sample_capture": "samples",
    "write_sample_n3tree": "samples",
    "write_sample_stage1": "samples",
    "write_shaders": "shaders",
}
_ARGUMENTS = {
    "Again": "refits",
    "Album": "photographs",
    "Batch": "batches",
    "Budget": "budgets",
    "Choice": "grids",
    "Compared": "comparisons",
    "Fitted": "fits",
    "FolderTarget": "files",
    "Goal": "compressions",
    "Item": "batches",
    "Limits": "comparisons",
    "Pages": "comparisons",
    "Model": "refits",
    "Photographs": "compressions",
    "Pictures": "pictures",
    "PlacedMesh": "pictures",
    "Recipe": "fits",
    "Refitted": "refits",
    "Run": "batches",
    "Seen": "comparisons",
    "Shots": "pictures",
    "Source": "files",
    "Stage1Source": "files",
    "Steps": "steps",
    "Target": "files",
}
_HOMES = JOBS | _ARGUMENTS
__all__ = sorted(_HOMES)


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'nerfbake.jobs' has no attribute {name!r}")
    return getattr(import_module(f"nerfbake.jobs.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return __all__
