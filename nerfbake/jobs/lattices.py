"""Convert octrees to PlenVDB lattices."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Unpack

from nerfbake import io
from nerfbake.jobs.budgets import UNLIMITED, Budget, judge_output
from nerfbake.jobs.files import AnySource, FolderTarget, as_source
from nerfbake.jobs.readings import compact_octree, lattice_loss, without_scenery
from nerfbake.jobs.steps import SILENT, Steps
from nerfbake.scene.lattice_field import LatticeField
from nerfbake.scene.n3tree import N3Tree
from nerfbake.scene.octree import SparseVoxelOctree

if TYPE_CHECKING:
    from nerfbake.stages.octree_to_lattice import LatticeOptions

FINEST = 256  # default limit for the voxels along an axis of a lattice: those programs store all of its nodes


def bake_lattice(
    source: AnySource,
    target: FolderTarget | str | Path,
    *,
    resolution: int | tuple[int, int, int] | None = None,
    sigma_min: float | None = None,
    merged: bool = False,
    budget: Budget = UNLIMITED,
    steps: Steps = SILENT,
    **options: Unpack[LatticeOptions],
) -> LatticeField:
    """Convert a PlenOctree or an octree to a lattice with an MLP and return it. This is `nerfbake lattice`.

    Reads `source` and the cameras of the budget. Writes the folder `target`, or `target`.rejected if the budget is
    missed. Raises NerfbakeError.

    resolution  of a PlenOctree, as in build_octree(); None: its finest, at most 256
    merged      store values once, as rows of float16
    sigma_min   and the other options are passed to build_lattice()

    >>> bake_lattice("a.npz", "a_lattice", resolution=16, rounds=20).colour.features
    12
    """

    from nerfbake.stages.octree_to_lattice import build_lattice
    from nerfbake.stages.scene_to_field import build_field_from_octree

    source = as_source(source)
    target = target if isinstance(target, FolderTarget) else FolderTarget(str(target))
    budget.require_folder(target, "LatticeField", (source.path, *budget.inputs))
    scene = without_scenery(steps, source, source.read(steps, N3Tree, SparseVoxelOctree))
    judged = None if budget.min_psnr is None else scene
    with source.blamed(steps, "building the octree"):
        if isinstance(scene, N3Tree) and resolution is None:
            resolution = min(scene.resolution, FINEST)
        scene = compact_octree(scene, resolution, sigma_min)
    with source.blamed(steps, "fitting the lattice"):
        lattice = build_lattice(scene, sigma_min=sigma_min, **options)
    with target.writing(steps, lattice, merged=merged) as written:
        with source.blamed(steps, "measuring the loss of the lattice"):
            # Without merged, reading the folder would give the same values in dense arrays.
            read = io.load_folder(written.path, LatticeField) if merged else lattice
            decibels, apart = lattice_loss(read, build_field_from_octree(scene))
        seen = f"{decibels:.1f} dB against pictures of the octree; colours differ by {apart:.2g}/255 (RMS)"
        steps.say(f"{target.path}: {lattice}, {seen}, {written.size:,} bytes")
        judge_output(written.path, judged, budget, made_from=source.name, name=target.path, steps=steps)
    return lattice
