"""What was read, as the octree that a job needs: of PlenOctrees the inner cube, and lattices and splats in voxels."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Literal

from nerfbake.errors import UsageError
from nerfbake.jobs.files import Source
from nerfbake.jobs.splat_voxels import sample_splats
from nerfbake.jobs.steps import Steps
from nerfbake.scene.held_out import HeldOut
from nerfbake.scene.lattice_field import LatticeField
from nerfbake.scene.n3tree import N3Tree
from nerfbake.scene.octree import Layout, SparseVoxelOctree
from nerfbake.scene.splats import Splats

if TYPE_CHECKING:
    from nerfbake.scene.radiance_field import RadianceField

_FRAMES, _EDGE = 4, 200  # number and edge of the pictures on which the loss of a conversion is measured


def read_octree(steps: Steps, source: Source) -> SparseVoxelOctree:
    """Read an octree, or convert a PlenOctree (at its own resolution), a lattice or splats to one."""
    return read_octree_and_held_out(steps, source)[0]


def read_octree_and_held_out(steps: Steps, source: Source) -> tuple[SparseVoxelOctree, HeldOut | None]:
    """Like read_octree(), and also return the pixels of photographs that a fitted PlenOctree stores."""

    from nerfbake.stages.n3tree_to_octree import build_octree

    scene = without_scenery(steps, source, source.read(steps, N3Tree, SparseVoxelOctree, LatticeField, Splats))
    if isinstance(scene, SparseVoxelOctree):
        return scene, None
    if isinstance(scene, Splats):
        return sample_splats(steps, source, scene)[0], None
    if isinstance(scene, LatticeField):
        return sample_lattice(steps, source, scene), None
    with source.blamed(steps, "building the octree"):
        return build_octree(scene), scene.held_out


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
        decibels, apart = lattice_loss(lattice, build_field_from_octree(octree))
    voxels = f"{'x'.join(map(str, octree.size))} voxels{_chosen(lattice, octree, resolution)}"
    seen = f"{decibels:.1f} dB against pictures of the lattice"
    steps.say(f"{source.name}: in {voxels}, {seen}; colours differ by {apart:.2g}/255 (RMS)")
    return octree


def _chosen(lattice: LatticeField, octree: SparseVoxelOctree, resolution: Any) -> str:
    """Return the reason why an octree without a chosen resolution is coarser than the cells of the lattice."""
    if resolution is not None or lattice.blocks is None or octree.size == lattice.cells:
        return ""
    return f" (the finest that fit into memory; it has {'x'.join(map(str, lattice.cells))} cells)"


def lattice_loss(lattice: LatticeField, field: RadianceField) -> tuple[float, float]:
    """Return the PSNR in dB of pictures around the lattice, and the RMS error of its colours (0..255)."""

    from nerfbake.jobs.views import orbit_psnr
    from nerfbake.stages.lattice_to_image import measure_lattice

    return orbit_psnr(lattice, field, _FRAMES, _EDGE), measure_lattice(lattice, field)
