"""Convert lattices from other programs to octrees, and octrees to PlenVDB lattices.

Jobs that read PlenOctrees and octrees use sample_lattice() to read lattices, too.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Unpack

from nerfbake import io
from nerfbake.errors import UsageError
from nerfbake.jobs.budgets import UNLIMITED, Budget, judge_output
from nerfbake.jobs.files import AnySource, FolderTarget, Source, as_source
from nerfbake.jobs.steps import SILENT, Steps
from nerfbake.scene.lattice_field import LatticeField
from nerfbake.scene.n3tree import N3Tree
from nerfbake.scene.octree import Layout, SparseVoxelOctree

if TYPE_CHECKING:
    from nerfbake.scene.radiance_field import RadianceField
    from nerfbake.stages.octree_to_lattice import LatticeOptions

FINEST = 256  # default limit for the voxels along an axis of a lattice: those programs store all of its nodes
_FRAMES, _EDGE = 4, 200  # number and edge of the pictures on which the loss of a conversion is measured


def sample_lattice(
    steps: Steps,
    source: Source,
    lattice: LatticeField,
    *,
    resolution: int | tuple[int, int, int] | None = None,
    basis: str = "SH9",
    layout: Layout = "full",
    dtype: Literal["float32", "float16"] = "float32",
    sigma_min: float | None = None,
) -> SparseVoxelOctree:
    """Sample a lattice to an octree, and print the error of its pictures and colours.

    The options are those of build_octree_from_lattice().
    """

    from nerfbake.stages.lattice_to_octree import build_octree_from_lattice
    from nerfbake.stages.scene_to_field import build_field_from_octree

    with source.blamed(steps, "sampling the lattice"):
        size = (resolution,) * 3 if isinstance(resolution, int) else resolution
        octree = build_octree_from_lattice(
            lattice, resolution=size, basis=basis, layout=layout, dtype=dtype, sigma_min=sigma_min
        )
    with source.blamed(steps, "measuring the loss of sampling"):
        decibels, apart = _lost(lattice, build_field_from_octree(octree))
    voxels = f"{'x'.join(map(str, octree.size))} voxels{_chosen(lattice, octree, resolution)}"
    seen = f"{decibels:.1f} dB against pictures of the lattice"
    steps.say(f"{source.name}: in {voxels}, {seen}; colours differ by {apart:.2g}/255 (RMS)")
    return octree


def _chosen(lattice: LatticeField, octree: SparseVoxelOctree, resolution: Any) -> str:
    """Return the reason why an octree without a chosen resolution is coarser than the cells of the lattice."""
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
            decibels, apart = _lost(read, build_field_from_octree(scene))
        seen = f"{decibels:.1f} dB against pictures of the octree; colours differ by {apart:.2g}/255 (RMS)"
        steps.say(f"{target.path}: {lattice}, {seen}, {written.size:,} bytes")
        judge_output(written.path, judged, budget, made_from=source.name, name=target.path, steps=steps)
    return lattice


def without_scenery(steps: Steps, source: Source, scene: Any) -> Any:
    """Return the inner cube of a PlenOctree with scenery, and print what is left out; else the scene itself."""
    if not isinstance(scene, N3Tree) or scene.shells == 1:
        return scene
    with source.blamed(steps, "reading the inner cube"):
        inner = scene.inner_cube()
    steps.say(f"{source.name}: uses the inner cube of {inner.resolution}^3 and leaves out the scenery around it")
    return inner


def compact_octree(
    scene: N3Tree | SparseVoxelOctree,
    resolution: int | tuple[int, int, int] | None,
    sigma_min: float | None,
) -> SparseVoxelOctree:
    """Return a compact octree of a PlenOctree; an octree is returned unchanged.

    A compact octree has no child slots for leaves, which saves a third of the memory. Raises UsageError if an octree is
    given with a resolution.
    """

    from nerfbake.stages.n3tree_to_octree import build_octree

    if isinstance(scene, N3Tree):
        return build_octree(scene, resolution=resolution, sigma_min=sigma_min, layout="compact")
    if resolution is not None:
        raise UsageError("an octree has its own resolution; allowed: `resolution` with a PlenOctree")
    return scene


def _lost(lattice: LatticeField, field: RadianceField) -> tuple[float, float]:
    """Return the PSNR in dB of pictures around the lattice, and the RMS error of its colours (0..255)."""

    from nerfbake.jobs.views import orbit_psnr
    from nerfbake.stages.lattice_to_image import measure_lattice

    return orbit_psnr(lattice, field, _FRAMES, _EDGE), measure_lattice(lattice, field)
