"""Octrees from files to files: baked from a PlenOctree, or cut at a level."""

from __future__ import annotations

from typing import Any

import nerfbake
from nerfbake.errors import UsageError
from nerfbake.jobs.budgets import UNLIMITED, Budget, judge
from nerfbake.jobs.files import AnySource, AnyTarget, Source, as_source, as_target
from nerfbake.jobs.lattices import octree_of
from nerfbake.jobs.steps import SILENT, Steps


def bake_octree(
    source: AnySource,
    target: AnyTarget,
    *,
    no_child: int | None = None,
    basis: str | None = None,
    scale: float | None = None,
    budget: Budget = UNLIMITED,
    steps: Steps = SILENT,
    **options: Any,
) -> nerfbake.SparseVoxelOctree:
    """Resamples a PlenOctree, or another program's lattice, to a sparse voxel octree, and gives what it wrote;
    `nerfbake svo` is this.

    Reads `source` and the budget's cameras; writes `target`, or `target`.rejected where the budget is missed. Options
    go to build_octree(), or to octree_of_lattice(). no_child: how the file spells 'no child', 0 or -1; None: as is
    usual for the format. Of a lattice alone: basis, None is SH9, and scale, how many times larger the world is to be
    than the file's. What is wrong with the arguments alone is told before anything is read. Raises NerfbakeError.

    >>> octree = bake_octree("a.npz", "a.svo.pb", resolution=16, budget=Budget(min_psnr=20))
    >>> octree.size
    (16, 16, 16)
    """
    source, target = as_source(source), as_target(target)
    target.require("SparseVoxelOctree", no_child=no_child)
    budget.require(target)
    scene = source.read(steps, nerfbake.N3Tree, nerfbake.LatticeField)
    if isinstance(scene, nerfbake.LatticeField):
        if options.pop("resample", "mean") != "mean":
            raise UsageError("`resample` is about leaves, which a lattice has none of; allowed: a PlenOctree")
        scene = scene if scale is None else scene.scaled(scale)
        octree = octree_of(steps, source, scene, basis=basis or "SH9", **options)
    else:
        if basis is not None or scale is not None:
            raise UsageError("a PlenOctree has its own basis and world; allowed: `basis` and `scale` with a lattice")
        with source.blamed(steps, "building the octree"):
            octree = nerfbake.build_octree(scene, **options)
    with target.writing(steps, octree, no_child=no_child) as written:
        judge(written.path, scene, budget, made_from=source.name, name=target.path, steps=steps)
    return octree


def bake_lod(
    source: AnySource,
    target: AnyTarget,
    *,
    level: int,
    no_child: int | None = None,
    budget: Budget = UNLIMITED,
    steps: Steps = SILENT,
) -> nerfbake.SparseVoxelOctree:
    """Cuts an octree at a level, and gives what it wrote; `nerfbake lod` is this.

    Reads `source` and the budget's cameras; writes `target`, or `target`.rejected where the budget is missed. level:
    the deepest one to keep, 0 is the root alone. no_child: how the file spells 'no child', 0 or -1; None: as
    is usual for the format. Raises NerfbakeError.

    >>> bake_lod("a.svo.pb", "a_3.svo.pb", level=3).size
    (8, 8, 8)
    """
    source, target = as_source(source), as_target(target)
    target.require("SparseVoxelOctree", no_child=no_child)
    budget.require(target)
    octree = source.read(steps, nerfbake.SparseVoxelOctree)
    with source.blamed(steps, f"cutting at level {level}"):
        cut = nerfbake.cut_octree(octree, level=level)
    with target.writing(steps, cut, no_child=no_child) as written:
        judge(written.path, octree, budget, made_from=source.name, name=target.path, steps=steps)
    return cut


def read_octree(steps: Steps, source: Source) -> nerfbake.SparseVoxelOctree:
    """The octree of a file, that of a PlenOctree at its own resolution, or that of a lattice."""
    return read_octree_and_held_out(steps, source)[0]


def read_octree_and_held_out(
    steps: Steps, source: Source
) -> tuple[nerfbake.SparseVoxelOctree, nerfbake.HeldOut | None]:
    """The same, and the pixels of photographs that a fitted PlenOctree has."""
    scene = source.read(steps, nerfbake.N3Tree, nerfbake.SparseVoxelOctree, nerfbake.LatticeField)
    if isinstance(scene, nerfbake.SparseVoxelOctree):
        return scene, None
    if isinstance(scene, nerfbake.LatticeField):
        return octree_of(steps, source, scene), None
    with source.blamed(steps, "building the octree"):
        return nerfbake.build_octree(scene), scene.held_out
