"""Convert scenes to PlenVDB lattices."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, Unpack

from nerfbake import io
from nerfbake.jobs.budgets import Budget, judge_output
from nerfbake.jobs.files import AnySource, FolderTarget, as_source
from nerfbake.jobs.function_voxels import FunctionVoxels
from nerfbake.jobs.readings import Reading, Size, lattice_loss
from nerfbake.jobs.steps import SILENT, Steps
from nerfbake.scene.lattice_field import LatticeField
from nerfbake.scene.n3tree import N3Tree

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
    functions: FunctionVoxels = FunctionVoxels(),
    budget: Budget = Budget(),
    steps: Steps = SILENT,
    **options: Unpack[LatticeOptions],
) -> LatticeField:
    """Convert a scene to a lattice with an MLP and return it. This is `nerfbake lattice`.

    Reads `source` and the cameras of the budget. Writes the folder `target`, or `target`.rejected if the budget is
    missed. Raises NerfbakeError.

    resolution  of all but octrees and volumes, as in bake_octree(); None: the finest of a PlenOctree, at most 256
    merged      store values once, as rows of float16
    functions   how a trained field becomes voxels
    sigma_min   and the other options are passed to build_lattice()

    >>> bake_lattice("a.npz", "a_lattice", resolution=16, rounds=20).colour.features
    12
    """

    from nerfbake.stages.octree_to_lattice import build_lattice
    from nerfbake.stages.scene_to_field import build_field_from_octree

    source = as_source(source)
    target = target if isinstance(target, FolderTarget) else FolderTarget(str(target))
    budget.require_folder(target, "LatticeField", (source.path, *budget.inputs))
    reading = Reading(steps, source, functions=functions)
    reading.require(resolution=resolution)
    reading.bake(resolution, sigma_min)
    reading.use_inner_cube()
    if resolution is None:
        resolution = _finest(reading.scene)
    octree = reading.octree(resolution=resolution, sigma_min=sigma_min, layout="compact")
    if budget.min_psnr is None:
        reading.shown = None  # without a budget, the tree is freed here
    with source.blamed(steps, "fitting the lattice"):
        lattice = build_lattice(octree, sigma_min=sigma_min, **options)
    with target.writing(steps, lattice, merged=merged) as written:
        with source.blamed(steps, "measuring the loss of the lattice"):
            # Without merged, reading the folder would give the same values in dense arrays.
            read = io.load_folder(written.path, LatticeField) if merged else lattice
            decibels, apart = lattice_loss(read, build_field_from_octree(octree))
        seen = f"{decibels:.1f} dB against pictures of the octree; colours differ by {apart:.2g}/255 (RMS)"
        steps.say(f"{target.path}: {lattice}, {seen}, {written.size:,} bytes")
        judge_output(written.path, reading.shown, budget, made_from=source.name, name=target.path, steps=steps)
    return lattice


def _finest(scene: Any) -> Size | None:
    """Return the resolution of a PlenOctree, at most FINEST, and that of a finer lattice; None for all other scenes."""
    if isinstance(scene, N3Tree):
        return min(scene.resolution, FINEST)
    if isinstance(scene, LatticeField) and max(scene.cells) > FINEST:
        x, y, z = (min(count, FINEST) for count in scene.cells)
        return x, y, z
    return None
