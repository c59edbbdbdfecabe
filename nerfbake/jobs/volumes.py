"""Volumes from files to files: baked from a PlenOctree or an octree."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import nerfbake
from nerfbake import memory
from nerfbake.jobs.budgets import UNLIMITED, Budget, judge
from nerfbake.jobs.files import AnySource, AnyTarget, as_source, as_target
from nerfbake.jobs.grids import require_grids, tell_of_halves
from nerfbake.jobs.lattices import compact_octree, octree_of
from nerfbake.jobs.steps import SILENT, Steps


def bake_volume(
    source: AnySource,
    target: AnyTarget,
    *,
    grids: str | None = None,
    half: bool = False,
    codec: str | None = None,
    resolution: int | tuple[int, int, int] | None = None,
    sigma_min: float | None = None,
    up: Literal["y", "z"] = "z",
    budget: Budget = UNLIMITED,
    steps: Steps = SILENT,
) -> nerfbake.Volume:
    """Makes VDB grids of a PlenOctree, an octree or another program's lattice, and gives what it wrote; `nerfbake vdb`.

    Reads `source` and the budget's cameras; writes `target`, or `target`.rejected where the budget is missed.

    grids       some of density, Cd, sh, with commas between them, or index; None: those that are usual for the format
    half        values are float16
    codec       of the format: none or zip; None: as is usual for it
    resolution  of a PlenOctree or a lattice, as build_octree() has it; sigma_min, for both, as it has that
    up          the axis that points up in `target`; in `source` it is z

    Raises NerfbakeError.

    >>> volume = bake_volume("a.npz", "a.vdb.npz", grids="density,sh", resolution=16)
    >>> [grid.name for grid in volume.grids]
    ['density', 'sh_0']
    """
    source, target = as_source(source), as_target(target)
    form = target.require("Volume", codec=codec)
    budget.require(target)
    wanted = require_grids(form, grids, half=half)
    scene: nerfbake.N3Tree | nerfbake.SparseVoxelOctree | nerfbake.LatticeField
    scene = source.read(steps, nerfbake.N3Tree, nerfbake.SparseVoxelOctree, nerfbake.LatticeField)
    judged = None if budget.min_psnr is None else scene  # the tree goes as soon as nobody needs it
    if isinstance(scene, nerfbake.LatticeField):
        size = (resolution,) * 3 if isinstance(resolution, int) else resolution
        scene, resolution = octree_of(steps, source, scene, resolution=size, sigma_min=sigma_min), None
    with source.blamed(steps, "building the grids"):
        own = not isinstance(scene, nerfbake.N3Tree)
        scene = compact_octree(scene, resolution, sigma_min)
        volume = nerfbake.build_vdb(scene, grids=wanted, half=half, up=up, sigma_min=sigma_min)
        volume = volume if own else _as_of_a_full_octree(volume)
    tell_of_halves(steps, form, volume)
    with target.writing(steps, volume, codec=codec) as written:
        judge(written.path, judged, budget, made_from=source.name, name=target.path, up=up, steps=steps)
    return volume


def _as_of_a_full_octree(volume: nerfbake.Volume) -> nerfbake.Volume:
    """The same volume, to come back as the octree that `nerfbake svo` makes of the tree."""
    assert volume.frame is not None
    return memory.kept(replace(volume, frame=replace(volume.frame, layout="full")))
