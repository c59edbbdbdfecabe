"""Bake octrees and volumes from PlenOctrees, lattices, splats and octrees, and cut octrees at a level."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any, Literal

from nerfbake import memory
from nerfbake.errors import UsageError
from nerfbake.jobs.budgets import UNLIMITED, Budget, judge_output
from nerfbake.jobs.files import AnySource, AnyTarget, Source, as_source, as_target
from nerfbake.jobs.grids import require_grids, warn_about_halves
from nerfbake.jobs.readings import compact_octree, sample_lattice, without_scenery
from nerfbake.jobs.splat_voxels import UPRIGHT, USUAL, Part, SplatVoxels, sample_splats
from nerfbake.jobs.steps import SILENT, Steps
from nerfbake.scene.lattice_field import LatticeField
from nerfbake.scene.n3tree import N3Tree
from nerfbake.scene.octree import MAX_SIZE, Layout, SparseVoxelOctree
from nerfbake.scene.splats import Splats
from nerfbake.scene.volume import Volume

if TYPE_CHECKING:
    from nerfbake.stages.n3tree_to_octree import Resample

Size = int | tuple[int, int, int]


def bake_octree(
    source: AnySource,
    target: AnyTarget,
    *,
    resolution: int | tuple[int, int, int] | None = None,
    box: Part = "inner",
    splats: SplatVoxels = USUAL,
    resample: Resample = "mean",
    layout: Layout = "full",
    dtype: Literal["float32", "float16"] = "float32",
    sigma_min: float | None = None,
    no_child: int | None = None,
    basis: str | None = None,
    scale: float | None = None,
    budget: Budget = UNLIMITED,
    steps: Steps = SILENT,
) -> SparseVoxelOctree:
    """Resample a PlenOctree, a lattice or splats to a sparse voxel octree and return it. This is `nerfbake svo`.

    Reads `source` and the cameras of the budget. Writes `target`, or `target`.rejected if the budget is missed. Raises
    NerfbakeError; errors that depend on the arguments alone are raised before anything is read.

    box       part of the scene. inner: of a scene with scenery its inner cube, of splats those that are not far
              outside; all: also the shells around it, at most at 4096^3, or all splats; x0, y0, z0, x1, y1, z1: the
              splats in this box of the octree's world
    splats    how splats become voxels
    no_child  child index that means 'no child' in the file, 0 or -1; None: the default of the format
    basis     SH basis of the colours (lattices and splats only); None: SH9, or the degree of the splats
    scale     scale factor for world coordinates (lattices only)

    resolution, resample, layout, dtype and sigma_min are those of build_octree(), build_octree_from_lattice() and
    build_octree_from_splats().

    >>> octree = bake_octree("a.npz", "a.svo.pb", resolution=16, budget=Budget(min_psnr=20))
    >>> octree.size
    (16, 16, 16)
    """

    from nerfbake.stages.n3tree_to_octree import build_octree

    source, target = as_source(source), as_target(target)
    target.require("SparseVoxelOctree", no_child=no_child)
    budget.require(target)
    scene = source.read(steps, N3Tree, LatticeField, Splats)
    _require_used(scene, splats=splats, box=box, resample=resample, basis=basis, scale=scale, budget=budget)
    if box == "inner":
        scene = without_scenery(steps, source, scene)
    elif isinstance(scene, N3Tree):
        resolution = _with_scenery(steps, source, scene, resolution)
    made: dict[str, Any] = {"resolution": resolution, "layout": layout, "dtype": dtype, "sigma_min": sigma_min}
    if isinstance(scene, Splats):
        octree, scene = sample_splats(steps, source, scene, options=splats, part=box, basis=basis, **made)
    elif isinstance(scene, LatticeField):
        scene = scene if scale is None else scene.scaled(scale)
        octree = sample_lattice(steps, source, scene, basis=basis or "SH9", **made)
    else:
        with source.blamed(steps, "building the octree"):
            octree = build_octree(scene, resample=resample, **made)
    with target.writing(steps, octree, no_child=no_child) as written:
        judge_output(written.path, scene, budget, made_from=source.name, name=target.path, steps=steps)
    return octree


def _require_used(
    scene: N3Tree | LatticeField | Splats,
    *,
    splats: SplatVoxels,
    box: Part,
    resample: Resample,
    basis: str | None,
    scale: float | None,
    budget: Budget,
) -> None:
    """Raise UsageError for options of bake_octree() that have no effect on the scene."""
    if isinstance(scene, Splats):
        splats.require(budget, scene)
        if resample != "mean" or scale is not None:
            raise UsageError("`resample` and `scale` have no effect on splats; allowed: with a PlenOctree or a lattice")
        return
    splats.require_default()
    if not isinstance(box, str):
        raise UsageError("`box` of six numbers has no effect on other scenes than splats; allowed: inner, all")
    if isinstance(scene, LatticeField):
        if box != "inner":
            raise UsageError("`box` has no effect on a lattice, which has no shells; allowed: with a PlenOctree")
        if resample != "mean":
            raise UsageError("`resample` has no effect on a lattice, which has no leaves; allowed: with a PlenOctree")
    elif basis is not None or scale is not None:
        raise UsageError("a PlenOctree has its own basis and world; allowed: `basis` and `scale` with a lattice")


def _with_scenery(steps: Steps, source: Source, tree: N3Tree, resolution: Size | None) -> Size | None:
    """Return the resolution of the whole cube, at most the largest of an octree; print what the inner cube gets of it.

    A tree without scenery keeps its resolution.
    """
    if tree.shells == 1:
        return resolution
    with source.blamed(steps, "reading the tree"):
        finest = tree.resolution
    size = min(finest, MAX_SIZE) if resolution is None else resolution
    times = 1 << (tree.shells - 1)
    inner = f"{_told(size, times)} of them in the inner cube of {finest // times}^3"
    steps.say(f"{source.name}: uses all of the scene: {_told(size, 1)} voxels, {inner}")
    return size


def _told(size: Size, times: int) -> str:
    edges = (size,) * 3 if isinstance(size, int) else size
    return "x".join(f"{edge / times:g}" for edge in edges)


def bake_lod(
    source: AnySource,
    target: AnyTarget,
    *,
    level: int,
    no_child: int | None = None,
    budget: Budget = UNLIMITED,
    steps: Steps = SILENT,
) -> SparseVoxelOctree:
    """Cut an octree at a level and return the result. This is `nerfbake lod`.

    Reads `source` and the cameras of the budget. Writes `target`, or `target`.rejected if the budget is missed. Raises
    NerfbakeError.

    level     deepest level to keep; 0 keeps only the root
    no_child  child index that means 'no child' in the file, 0 or -1; None: the default of the format

    >>> bake_lod("a.svo.pb", "a_3.svo.pb", level=3).size
    (8, 8, 8)
    """

    from nerfbake.stages.octree_to_octree import cut_octree

    source, target = as_source(source), as_target(target)
    target.require("SparseVoxelOctree", no_child=no_child)
    budget.require(target)
    octree = source.read(steps, SparseVoxelOctree)
    with source.blamed(steps, f"cutting at level {level}"):
        cut = cut_octree(octree, level=level)
    with target.writing(steps, cut, no_child=no_child) as written:
        judge_output(written.path, octree, budget, made_from=source.name, name=target.path, steps=steps)
    return cut


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
    box: Part = "inner",
    splats: SplatVoxels = UPRIGHT,
    budget: Budget = UNLIMITED,
    steps: Steps = SILENT,
) -> Volume:
    """Convert a PlenOctree, an octree, a lattice or splats to VDB grids and return the volume. This is `nerfbake vdb`.

    Reads `source` and the cameras of the budget. Writes `target`, or `target`.rejected if the budget is missed.

    grids       some of density, Cd and sh, separated by commas, or index; None: the default of the format
    half        store values as float16
    codec       of the format: none or zip; None: the default of the format
    resolution  of a PlenOctree, a lattice or splats, as in build_octree()
    sigma_min   of a PlenOctree, a lattice or splats, as in build_octree()
    up          up axis of `target`; the up axis of `source` is z, or that of `splats`
    box         part of splats, as in bake_octree()
    splats      how splats become voxels. By default the axis is up that their file states, else -y

    Raises NerfbakeError.

    >>> volume = bake_volume("a.npz", "a.vdb.npz", grids="density,sh", resolution=16)
    >>> [grid.name for grid in volume.grids]
    ['density', 'sh_0']
    """

    from nerfbake.stages.octree_to_vdb import build_vdb

    source, target = as_source(source), as_target(target)
    form = target.require("Volume", codec=codec)
    budget.require(target)
    wanted = require_grids(form, grids, half=half)
    scene: N3Tree | SparseVoxelOctree | LatticeField | Splats
    scene = without_scenery(steps, source, source.read(steps, N3Tree, SparseVoxelOctree, LatticeField, Splats))
    judged: N3Tree | SparseVoxelOctree | LatticeField | Splats | None
    judged = None if budget.min_psnr is None else scene  # without a budget, the tree can be freed early
    if isinstance(scene, Splats):
        splats.require(budget, scene)
        scene, shown = sample_splats(
            steps, source, scene, options=splats, part=box, resolution=resolution, sigma_min=sigma_min, layout="compact"
        )
        resolution = None
        if judged is not None:
            judged = shown
    else:
        splats._replace(up=None).require_default()
        if box != "inner":
            raise UsageError("`box` has no effect on other scenes than splats; allowed: with splats")
    if isinstance(scene, LatticeField):
        scene, resolution = sample_lattice(steps, source, scene, resolution=resolution, sigma_min=sigma_min), None
    with source.blamed(steps, "building the grids"):
        own = not isinstance(scene, N3Tree)
        scene = compact_octree(scene, resolution, sigma_min)
        volume = build_vdb(scene, grids=wanted, half=half, up=up, sigma_min=sigma_min)
        volume = volume if own else _with_full_layout(volume)
    warn_about_halves(steps, form, volume)
    with target.writing(steps, volume, codec=codec) as written:
        judge_output(written.path, judged, budget, made_from=source.name, name=target.path, up=up, steps=steps)
    return volume


def _with_full_layout(volume: Volume) -> Volume:
    """Set the layout of the volume's octree to full, the layout that `nerfbake svo` writes by default."""
    assert volume.frame is not None
    return memory.kept(replace(volume, frame=replace(volume.frame, layout="full")))
