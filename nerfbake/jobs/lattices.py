"""What other programs trained, as octrees: jobs that take PlenOctrees and octrees take these fields by it, too."""

from __future__ import annotations

from typing import Any

import nerfbake
from nerfbake.jobs.files import Source
from nerfbake.jobs.steps import Steps

_FRAMES, _EDGE = 4, 200  # of the pictures that tell what voxels lose


def octree_of(
    steps: Steps, source: Source, lattice: nerfbake.LatticeField, **options: Any
) -> nerfbake.SparseVoxelOctree:
    """octree_of_lattice() with these options; says what was left out, and what became of colours and pictures."""
    tell_notes(steps, source, lattice)
    with source.blamed(steps, "sampling the lattice"):
        octree = nerfbake.octree_of_lattice(lattice, **options)
    with source.blamed(steps, "measuring what voxels lose"):
        field = nerfbake.field_of_octree(octree)
        apart = nerfbake.measure_lattice(lattice, field)
        views = nerfbake.orbit_cameras(lattice, frames=_FRAMES, width=_EDGE, height=_EDGE)
        found = nerfbake.compare_scenes(lattice, field, views, keep_pictures=False)
    size = f"{'x'.join(map(str, octree.size))} voxels{_chosen(lattice, octree, options.get('resolution'))}"
    seen = f"{found.means['a_b']['psnr']:.1f} dB from the lattice's own pictures"
    steps.say(f"{source.name}: in {size}, {seen}; colours are {apart:.2g}/255 (RMS) from its own")
    return octree


def _chosen(lattice: nerfbake.LatticeField, octree: nerfbake.SparseVoxelOctree, resolution: Any) -> str:
    """Behind the voxels of an octree that nobody asked for, why they are coarser than the lattice's cells."""
    if resolution is not None or lattice.blocks is None or octree.size == lattice.cells:
        return ""
    return f" (the finest that fit into memory; it has {'x'.join(map(str, lattice.cells))} cells)"


def tell_notes(steps: Steps, source: Source, scene: Any) -> None:
    """Says what a lattice field's file holds that was left out."""
    if isinstance(scene, nerfbake.LatticeField):
        for note in scene.notes:
            steps.say(f"{source.name}: {note}")
