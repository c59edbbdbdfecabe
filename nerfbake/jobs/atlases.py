"""Bake atlases from stage-1 folders of nerf2mesh, and measure their error."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal, Unpack

from nerfbake import io
from nerfbake.jobs.budgets import Budget, judge_output, reporting
from nerfbake.jobs.files import FolderTarget, Stage1Source
from nerfbake.jobs.steps import SILENT, Steps
from nerfbake.kernels.surface.octahedron import TexelLookup
from nerfbake.scene.atlas import BakedAtlas
from nerfbake.scene.stage1 import Stage1
from nerfbake.stages.scene_to_cameras import orbit_cameras
from nerfbake.stages.specular_to_atlas import AtlasOptions
from nerfbake.stages.stage1_to_atlas import AtlasError, DirectionSet, bake_stage1, measure_stage1_error

Facts = dict[str, Any]


def bake_atlas_folder(
    source: Stage1Source | str | Path,
    target: FolderTarget | str | Path,
    *,
    directions: int = 100,
    direction_set: DirectionSet = "fibonacci",
    in_up: Literal["y", "z"] = "y",
    budget: Budget = Budget(),
    steps: Steps = SILENT,
    report: Callable[[Facts], None] | None = None,
    **options: Unpack[AtlasOptions],
) -> BakedAtlas:
    """Bake the specular MLP of a stage-1 folder into octahedral maps and return the atlas. This is `nerfbake atlas`.

    Reads `source` and the cameras of the budget. Writes the folder `target`, or `target`.rejected if the budget is
    missed. Raises NerfbakeError.

    in_up    the mesh axis that points up in scene.glb
    report   is called with the atlas's facts, errors and file sizes once the folder has its final name, also if it is
             rejected

    directions, direction_set and the other options are passed to bake_stage1().

    >>> atlas = bake_atlas_folder("mesh_stage1", "atlas_16", clusters=16, map_size=32)
    >>> atlas.atlases[0].K
    16
    """
    source = source if isinstance(source, Stage1Source) else Stage1Source(str(source))
    target = target if isinstance(target, FolderTarget) else FolderTarget(str(target))
    budget.require_folder(target, "BakedAtlas", (*source.inputs, *budget.inputs))
    stage1 = source.read(steps)
    if budget.min_psnr is not None:
        with source.blamed(steps, "framing"):
            orbit_cameras(stage1)  # raises early if there is no mesh to render
    with source.blamed(steps, "baking"):
        baked = bake_stage1(stage1, directions=directions, direction_set=direction_set, **options)
    sizes: dict[str, int] = {}
    reported = reporting(lambda: report({**baked.facts, "files": sizes}) if report is not None else None)
    with reported, target.writing(steps, baked, up=in_up) as written:
        sizes = written.sizes
        for error in baked.facts["errors"]:
            figures = f"MAE {error['mae']:.3f}, MSE {error['mse']:.3f} of 255"
            steps.say(f"{target.path}: {baked}, {figures}, {written.size:,} bytes")
        judge_output(written.path, stage1, budget, made_from=source.name, name=target.path, steps=steps)
    return baked


def measure_atlas(
    atlas: str | Path,
    stage1: str | Path,
    *,
    directions: int = 100,
    held_out: bool = False,
    lookup: TexelLookup = "bilinear",
    thesis_fault: bool = False,
    steps: Steps = SILENT,
) -> list[AtlasError]:
    """Return the AtlasError of each cascade, against the MLP of a stage-1 folder. This is `nerfbake atlas-error`.

    Reads both folders and writes nothing. The other options are passed to measure_stage1_error(). Raises NerfbakeError.

    >>> [error] = measure_atlas("atlas_16", "mesh_stage1", held_out=True)
    >>> error.mae < 20
    True
    """
    with steps.phase(f"reading {atlas}"):
        baked = io.load_folder(atlas, BakedAtlas)
    with steps.phase(f"reading {stage1}"):
        truth = io.load_folder(stage1, Stage1)
    with steps.phase("measuring"), io.blame(str(atlas)):
        return measure_stage1_error(
            baked, truth, directions=directions, held_out=held_out, lookup=lookup, thesis_fault=thesis_fault
        )
