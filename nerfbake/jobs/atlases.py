"""Atlases from folders to folders: baked from nerf2mesh's stage 1, and measured against it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import nerfbake
from nerfbake import io
from nerfbake.jobs.budgets import UNLIMITED, Budget, judge, reporting
from nerfbake.jobs.files import FolderTarget, Stage1Source
from nerfbake.jobs.steps import SILENT, Steps

Facts = dict[str, Any]


def bake_atlas(
    source: Stage1Source | str | Path,
    target: FolderTarget | str | Path,
    *,
    up: str = "y",
    budget: Budget = UNLIMITED,
    steps: Steps = SILENT,
    report: Callable[[Facts], None] | None = None,
    **options: Any,
) -> nerfbake.BakedAtlas:
    """Bakes the specular MLP of a stage-1 folder into octahedral maps, and gives what it wrote; `nerfbake atlas`.

    Reads `source` and the budget's cameras; writes the folder `target`, or `target`.rejected where the budget is
    missed. Options go to bake_stage1(). up: the mesh's axis that is up in scene.glb. report gets the atlas's facts,
    errors and sizes when the folder has its name, that of a rejected one too. Raises NerfbakeError.

    >>> atlas = bake_atlas("mesh_stage1", "atlas_16", clusters=16, map_size=32)
    >>> atlas.atlases[0].K
    16
    """
    source = source if isinstance(source, Stage1Source) else Stage1Source(str(source))
    target = target if isinstance(target, FolderTarget) else FolderTarget(str(target))
    target.require()
    budget.require(target)
    stage1 = source.read(steps)
    if budget.min_psnr is not None:
        with source.blamed(steps, "framing"):
            nerfbake.orbit_cameras(stage1)  # raises, before any work is done, where there is no mesh to look at
    with source.blamed(steps, "baking"):
        baked = nerfbake.bake_stage1(stage1, **options)
    sizes: dict[str, int] = {}
    told = reporting(lambda: report({**baked.facts, "files": sizes}) if report is not None else None)
    with told, target.writing(steps, baked, up=up) as written:
        sizes = written.sizes
        for error in baked.facts["errors"]:
            figures = f"MAE {error['mae']:.3f}, MSE {error['mse']:.3f} of 255"
            steps.say(f"{target.path}: {baked}, {figures}, {written.size:,} bytes")
        judge(written.path, stage1, budget, made_from=source.name, name=target.path, steps=steps)
    return baked


def measure_atlas(atlas: str | Path, stage1: str | Path, *, steps: Steps = SILENT, **options: Any) -> list[Any]:
    """The AtlasError of each cascade: how far an atlas's folder is from the MLP of a stage-1 folder; `atlas-error`.

    Reads both folders, writes nothing. Options go to measure_stage1_error(). Raises NerfbakeError.

    >>> [error] = measure_atlas("atlas_16", "mesh_stage1", held_out=True)
    >>> error.mae < 20
    True
    """
    with steps.phase(f"reading {atlas}"):
        baked = io.load_folder(atlas, nerfbake.BakedAtlas)
    with steps.phase(f"reading {stage1}"):
        truth = io.load_folder(stage1, nerfbake.Stage1)
    with steps.phase("measuring"), io.blame(str(atlas)):
        return nerfbake.measure_stage1_error(baked, truth, **options)
