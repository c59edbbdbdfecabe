"""Convert splats to octrees: cut them to a box, fill voxels, and fit these to pictures of the splats.

readings.py uses sample_splats() for all jobs.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

from nerfbake import memory, progress
from nerfbake.errors import MemoryLimit, UsageError
from nerfbake.jobs.files import Source
from nerfbake.jobs.reading_options import ReadingOptions
from nerfbake.jobs.steps import Steps
from nerfbake.jobs.upright import upside_down_note
from nerfbake.kernels.arrays import Points
from nerfbake.kernels.maths.affine import length
from nerfbake.scene.camera import Cameras
from nerfbake.scene.octree import Layout, SparseVoxelOctree
from nerfbake.scene.origin import lost_origin
from nerfbake.scene.splats import Splats
from nerfbake.scene.views import Views, world_box
from nerfbake.stages.splat_box import cut_splats, finest_voxels, inner_box, whole_box, with_z_up

RESOLUTION = 256  # most voxels along the longest edge, by default
_COARSEST = 16  # fewest voxels along the longest edge, if they are chosen by the memory that is left
_COARSER = 0.75  # of the voxels along an edge are tried next, if they do not fit into memory
# Number and edge of the pictures to which voxels are fitted. A real scene in 512^3 has 36.97 dB with 160 pictures that
# are used once, and 36.82 dB with 80 that are used twice, in a fifth less time. 144 stay below 40 seconds in 256^3.
_FRAMES, _EDGE = 144, 400
_JUDGES = 10  # number of other pictures, on which the loss is measured


def choose_splats(steps: Steps, source: Source, splats: Splats, options: ReadingOptions) -> tuple[Splats, Points]:
    """Return the splats that are converted, in the world of the octree, and the box (2, 3) of the voxels.

    Voxels stand at the origin of the splats. A box of six numbers is in the world before that shift.
    """
    least, part = options.opacity_min, options.box
    if note := upside_down_note(splats):
        steps.say(f"{source.name}: {note}")
    if options.in_up == "stated" and splats.up is not None:
        steps.say(f"{source.name}: {splats.up} points up, as the file says")
    with source.blamed(steps, "cutting the splats"):
        splats.require_usable()
        turned = with_z_up(splats, options.up_of(splats))
        if turned.origin.any():
            steps.say(f"{source.name}: {lost_origin(turned.origin, 'voxels')}")
        if part == "inner":
            box = inner_box(turned, opacity_min=least)
        elif part == "all":
            box = whole_box(turned, opacity_min=least)
        else:
            box = world_box(part) - turned.origin
        cut = cut_splats(turned, box, opacity_min=least)
    for note in cut.notes:
        steps.say(f"{source.name}: {note}")
    return cut.splats, box


def sample_splats(
    steps: Steps,
    source: Source,
    splats: Splats,
    *,
    options: ReadingOptions = ReadingOptions(),
    resolution: int | tuple[int, int, int] | None = None,
    layout: Layout = "full",
    dtype: Literal["float32", "float16"] = "float32",
    sigma_min: float | None = None,
) -> tuple[SparseVoxelOctree, Splats]:
    """Convert splats to an octree, fit it to their pictures, and print what was left out and the loss.

    Returns the octree, and the splats that it shows, in its world. The keywords besides `options` are those of
    build_octree_from_splats().
    """

    from nerfbake.jobs.views import orbit_psnr, picture_views
    from nerfbake.stages.scene_to_cameras import scatter_cameras
    from nerfbake.stages.splats_to_octree import build_octree_from_splats

    edges = {resolution} if isinstance(resolution, int) else set(resolution or ())
    if len(edges) > 1:
        raise UsageError("the voxels of splats are cubes; allowed: one number as `resolution`")
    kept, box = choose_splats(steps, source, splats, options)
    with source.blamed(steps, "framing"):
        cameras = scatter_cameras(kept, frames=_FRAMES, edge=_EDGE)
    size = min(edges, default=0) or finest_voxels(kept, box, most=RESOLUTION)
    views = None
    if options.epochs:
        with source.blamed(steps, "rendering pictures of the splats"):
            views = picture_views(kept, cameras, 1)

    def octree_of(size: int) -> tuple[SparseVoxelOctree, float]:
        with source.blamed(steps, "filling voxels"):
            octree = build_octree_from_splats(
                kept,
                resolution=size,
                box=box,
                opacity_min=0,
                sigma_min=sigma_min,
                pixel=pixel_of(cameras, box),
                basis=options.basis,
                layout=layout,
                dtype=dtype,
            )
        if views is not None:
            octree = _refitted(steps, source, octree, views, options.epochs)
        with source.blamed(steps, "measuring the loss"):
            return octree, orbit_psnr(kept, octree, _JUDGES, _EDGE)

    octree, decibels = octree_of(size) if edges else _fitting_into_memory(octree_of, size)
    why = "" if edges or max(octree.size) == size else " (the finest that fit into memory)"
    voxels = f"{'x'.join(map(str, octree.size))} voxels{why}"
    steps.say(f"{source.name}: in {voxels}, {decibels:.2f} dB against {_JUDGES} pictures of the splats")
    return octree, kept


def _fitting_into_memory(
    octree_of: Callable[[int], tuple[SparseVoxelOctree, float]], size: int
) -> tuple[SparseVoxelOctree, float]:
    """Return the octree with `size` voxels along its longest edge, or with as many as fit into memory, and its PSNR."""
    while True:
        try:
            with memory.scope():
                return octree_of(size)
        except MemoryLimit:
            if size <= _COARSEST:
                raise
        size = max(int(size * _COARSER), _COARSEST)


def _refitted(steps: Steps, source: Source, octree: SparseVoxelOctree, views: Views, epochs: int) -> SparseVoxelOctree:
    """Return the octree with values fitted to pictures of the splats."""
    from nerfbake.stages.brick_field_to_brick_field import refit_bricks
    from nerfbake.stages.brick_field_to_octree import fill_octree
    from nerfbake.stages.octree_to_brick_field import build_bricks

    with source.blamed(steps, "fitting the voxels to them"):
        count = epochs * len(views.pictures)
        for done, state in enumerate(refit_bricks(build_bricks(octree), views, epochs=epochs)):
            progress.report(done / count, f"epoch {state.epoch + 1} of {epochs}")
        return fill_octree(octree, state.field())


def pixel_of(cameras: Cameras, box: Points) -> float:
    """Return the edge of a pixel in world units, in the middle of a box."""
    camera, middle = cameras.cameras[0], box.mean(axis=0)
    return length(camera.pose[:3, 3] - middle) / camera.fx
