"""What other programs trained, as octrees: jobs that take PlenOctrees and octrees take these fields by it, too. And the
way back: an octree as they would have trained it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import nerfbake
from nerfbake import io
from nerfbake.errors import UsageError
from nerfbake.jobs.budgets import UNLIMITED, Budget, judge
from nerfbake.jobs.files import AnySource, FolderTarget, Source, as_source
from nerfbake.jobs.steps import SILENT, Steps

FINEST = 256  # voxels along an axis of a lattice, unless told otherwise: those programs hold all of its nodes
_FRAMES, _EDGE = 4, 200  # of the pictures that tell what voxels lose, and what a lattice does


def octree_of(
    steps: Steps, source: Source, lattice: nerfbake.LatticeField, **options: Any
) -> nerfbake.SparseVoxelOctree:
    """octree_of_lattice() with these options; says what was left out, and what became of colours and pictures."""
    tell_notes(steps, source, lattice)
    with source.blamed(steps, "sampling the lattice"):
        octree = nerfbake.octree_of_lattice(lattice, **options)
    with source.blamed(steps, "measuring what voxels lose"):
        decibels, apart = _lost(lattice, nerfbake.field_of_octree(octree))
    size = f"{'x'.join(map(str, octree.size))} voxels{_chosen(lattice, octree, options.get('resolution'))}"
    seen = f"{decibels:.1f} dB from the lattice's own pictures"
    steps.say(f"{source.name}: in {size}, {seen}; colours are {apart:.2g}/255 (RMS) from its own")
    return octree


def _chosen(lattice: nerfbake.LatticeField, octree: nerfbake.SparseVoxelOctree, resolution: Any) -> str:
    """Behind the voxels of an octree that nobody asked for, why they are coarser than the lattice's cells."""
    if resolution is not None or lattice.blocks is None or octree.size == lattice.cells:
        return ""
    return f" (the finest that fit into memory; it has {'x'.join(map(str, lattice.cells))} cells)"


def bake_lattice(
    source: AnySource,
    target: FolderTarget | str | Path,
    *,
    resolution: int | tuple[int, int, int] | None = None,
    sigma_min: float | None = None,
    merged: bool = False,
    budget: Budget = UNLIMITED,
    steps: Steps = SILENT,
    **options: Any,
) -> nerfbake.LatticeField:
    """Makes a lattice with an MLP of a PlenOctree or an octree, and gives what it wrote; `nerfbake lattice` is this.

    Reads `source` and the budget's cameras; writes the folder `target`, or `target`.rejected where the budget is
    missed. resolution: of a PlenOctree, as build_octree() has it; None: its finest, but 256 at most. merged: values
    are stored once, as rows of float16. sigma_min and the options go to lattice_of_octree(). Raises NerfbakeError.

    >>> bake_lattice("a.npz", "a_lattice", resolution=16, rounds=20).colour.features
    12
    """
    source = as_source(source)
    target = target if isinstance(target, FolderTarget) else FolderTarget(str(target))
    target.require()
    budget.require(target)
    scene = source.read(steps, nerfbake.N3Tree, nerfbake.SparseVoxelOctree)
    judged = None if budget.min_psnr is None else scene
    with source.blamed(steps, "building the octree"):
        if isinstance(scene, nerfbake.N3Tree) and resolution is None:
            resolution = min(scene.resolution, FINEST)
        scene = compact_octree(scene, resolution, sigma_min)
    with source.blamed(steps, "fitting the lattice"):
        lattice = nerfbake.lattice_of_octree(scene, sigma_min=sigma_min, **options)
    with target.writing(steps, lattice, merged=merged) as written:
        with source.blamed(steps, "measuring what the lattice loses"):
            # What is not merged comes back as it is here, but dense.
            read = io.load_folder(written.path, nerfbake.LatticeField) if merged else lattice
            decibels, apart = _lost(read, nerfbake.field_of_octree(scene))
        seen = f"{decibels:.1f} dB from the octree's own pictures; colours are {apart:.2g}/255 (RMS) from its own"
        steps.say(f"{target.path}: {lattice}, {seen}, {written.size:,} bytes")
        judge(written.path, judged, budget, made_from=source.name, name=target.path, steps=steps)
    return lattice


def compact_octree(
    scene: nerfbake.N3Tree | nerfbake.SparseVoxelOctree,
    resolution: int | tuple[int, int, int] | None,
    sigma_min: float | None,
) -> nerfbake.SparseVoxelOctree:
    """Of a PlenOctree its octree, for a stage that asks for no child slots of leaves, which are a third of the memory;
    an octree is what it is. Raises UsageError where an octree is asked for another resolution."""
    if isinstance(scene, nerfbake.N3Tree):
        return nerfbake.build_octree(scene, resolution=resolution, sigma_min=sigma_min, layout="compact")
    if resolution is not None:
        raise UsageError("an octree has its own resolution; allowed: `resolution` with a PlenOctree")
    return scene


def _lost(lattice: nerfbake.LatticeField, field: nerfbake.RadianceField) -> tuple[float, float]:
    """How far the two are apart: dB of pictures around the lattice, and colours (RMS, in 0..255)."""
    views = nerfbake.orbit_cameras(lattice, frames=_FRAMES, width=_EDGE, height=_EDGE)
    found = nerfbake.compare_scenes(lattice, field, views, keep_pictures=False)
    return float(found.means["a_b"]["psnr"]), nerfbake.measure_lattice(lattice, field)


def tell_notes(steps: Steps, source: Source, scene: Any) -> None:
    """Says what a lattice field's file holds that was left out."""
    if isinstance(scene, nerfbake.LatticeField):
        for note in scene.notes:
            steps.say(f"{source.name}: {note}")
