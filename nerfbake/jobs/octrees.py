"""Bake octrees and volumes from PlenOctrees, lattices, splats and octrees, and cut octrees at a level."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Literal

from nerfbake import io, memory
from nerfbake.jobs.budgets import Budget, judge_output
from nerfbake.jobs.files import AnySource, AnyTarget, as_source, as_target
from nerfbake.jobs.function_voxels import FunctionVoxels
from nerfbake.jobs.grids import require_grids, warn_about_halves
from nerfbake.jobs.reading_options import ReadingOptions
from nerfbake.jobs.readings import TAKEN, Reading
from nerfbake.jobs.steps import SILENT, Steps
from nerfbake.scene.function_field import FunctionField
from nerfbake.scene.lattice_field import LatticeField
from nerfbake.scene.n3tree import N3Tree
from nerfbake.scene.octree import Layout, SparseVoxelOctree
from nerfbake.scene.splats import Splats
from nerfbake.scene.volume import Volume

if TYPE_CHECKING:
    from nerfbake.stages.n3tree_to_octree import Resample


def bake_octree(
    source: AnySource,
    target: AnyTarget,
    *,
    resolution: int | tuple[int, int, int] | None = None,
    options: ReadingOptions = ReadingOptions(),
    functions: FunctionVoxels = FunctionVoxels(),
    resample: Resample = "mean",
    layout: Layout = "full",
    dtype: Literal["float32", "float16"] = "float32",
    sigma_min: float | None = None,
    no_child: int | None = None,
    budget: Budget = Budget(),
    steps: Steps = SILENT,
) -> SparseVoxelOctree:
    """Make a sparse voxel octree of a scene and return it. This is `nerfbake svo`.

    Reads `source` and the cameras of the budget. Writes `target`, or `target`.rejected if the budget is missed. Raises
    NerfbakeError; errors that depend on the arguments alone are raised before anything is read.

    options   how the scene becomes an octree
    functions  how a trained field becomes voxels
    no_child  child index that means 'no child' in the file, 0 or -1; None: the default of the format

    resolution, resample, layout, dtype and sigma_min are those of build_octree(), build_octree_from_lattice() and
    build_octree_from_splats(). Octrees and volumes, which have their own voxels, take the layout alone.

    >>> octree = bake_octree("a.npz", "a.svo.pb", resolution=16, budget=Budget(min_psnr=20))
    >>> octree.size
    (16, 16, 16)
    """

    source, target = as_source(source), as_target(target)
    target.require("SparseVoxelOctree", no_child=no_child)
    budget.require(target)
    reading = Reading(steps, source, options=options, functions=functions)
    reading.require(budget, resolution=resolution, sigma_min=sigma_min, dtype=dtype, resample=resample)
    octree = reading.octree(resolution=resolution, resample=resample, layout=layout, dtype=dtype, sigma_min=sigma_min)
    octree = octree.with_layout(layout)  # of an octree, which is not made anew
    with target.writing(steps, octree, no_child=no_child) as written:
        judge_output(written.path, reading.shown, budget, made_from=source.name, name=target.path, steps=steps)
    return octree


def bake_lod(
    source: AnySource,
    target: AnyTarget,
    *,
    level: int,
    no_child: int | None = None,
    budget: Budget = Budget(),
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
    options: ReadingOptions = ReadingOptions(in_up="stated"),
    functions: FunctionVoxels = FunctionVoxels(),
    budget: Budget = Budget(),
    steps: Steps = SILENT,
    report: Callable[[float], None] | None = None,
) -> Volume:
    """Convert a scene to VDB grids and return the volume. This is `nerfbake vdb`.

    Reads `source` and the cameras of the budget. Writes `target`, or `target`.rejected if the budget is missed.

    grids       some of density, Cd and sh, separated by commas, or index; None: the default of the format
    half        store values as float16
    codec       of the format: none or zip; None: the default of the format
    resolution  of all but octrees and volumes, as in bake_octree()
    sigma_min   of all but octrees and volumes, as in bake_octree()
    up          up axis of `target`; the up axis of `source` is z, or that of `options`
    options     how the scene becomes an octree. By default the axis of splats is up that their file states, else -y
    functions   how a trained field becomes voxels
    report      is called with the mean PSNR in dB, if the budget has a limit

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
    reading = Reading(steps, source, options=options, functions=functions)
    reading.require(budget, taken=TAKEN | {"box": (Splats, FunctionField)}, resolution=resolution)
    tree, lattice = (isinstance(reading.scene, kind) for kind in ((N3Tree, FunctionField), LatticeField))
    octree = reading.octree(resolution=resolution, sigma_min=sigma_min, layout="full" if lattice else "compact")
    if budget.min_psnr is None:
        reading.shown = None  # without a budget, the tree is freed here
    with source.blamed(steps, "building the grids"):
        volume = build_vdb(octree, grids=wanted, half=half, up=up, sigma_min=sigma_min)
        volume = _with_full_layout(volume) if tree else volume
    warn_about_halves(steps, form, volume)
    axis = up if form.choices("up") else None
    with target.writing(steps, volume, codec=codec, up=axis) as written:
        made = written.path if form.readable else io.paths_beside(written.path, form, to=target.to)[0]
        psnr = judge_output(made, reading.shown, budget, made_from=source.name, name=target.path, up=up, steps=steps)
    if report is not None and psnr is not None:
        report(psnr)
    return volume


def _with_full_layout(volume: Volume) -> Volume:
    """Set the layout of the volume's octree to full, the layout that `nerfbake svo` writes by default."""
    assert volume.frame is not None
    return memory.kept(replace(volume, frame=replace(volume.frame, layout="full")))
