"""Posed pictures -> their visual hull, from which a fit starts."""

from __future__ import annotations

import numpy as np

from nerfbake import memory
from nerfbake.errors import InvalidScene, Problem
from nerfbake.kernels.arrays import Bits, Points
from nerfbake.kernels.dilation import dilated
from nerfbake.kernels.fit.hull import TASKS, mark_clear
from nerfbake.kernels.parallel import prefetched
from nerfbake.scene.basis import Basis
from nerfbake.scene.brick_field import BrickField
from nerfbake.scene.views import Views
from nerfbake.stages._bricks import cells_of_solid, field_of_cells
from nerfbake.stages._ray_targets import KeptTargets, RayTargets

MIN_VIEWS = 2
_EDGE = 128  # approximate number of pixels along a silhouette's shorter edge
_WITNESSES = 5  # views that must cover a cell with background only to remove it, if pictures have no exact alpha
_SEARCH = 32  # cells along an axis during the search for the box
_ROUNDS = 4
_CELL_BYTES = 7 + TASKS


def carve_hull(views: Views, *, box: Points | None = None, resolution: int = 64) -> BrickField:
    """Return the visual hull: cells that two views or more see, and that no view covers with background only.

    box (2, 3): lowest and highest corner in the world; None: the box around the visual hull in the space that the
    cameras have in common. If pictures have no alpha, or rough masks, five views must cover a cell with background only
    to remove it. All cells are grey with a low density. Raises InvalidScene if no cell remains, MemoryLimit.

    >>> from nerfbake import Views, build_field, carve_hull, orbit_cameras, render_field, sample_n3tree
    >>> scene = build_field(sample_n3tree(resolution=8))
    >>> cameras = orbit_cameras(scene, frames=4, width=24, height=24)
    >>> pictures = tuple(render_field(scene, camera, background=None).pixels for camera in cameras.cameras)
    >>> hull = carve_hull(Views(cameras, pictures, (1.0, 1.0, 1.0), True), resolution=16)
    >>> hull.resolution, bool(0 < hull.n < 16**3)
    (16, True)
    """
    require_views(views)
    solid, box = find_solid(views, box, resolution)
    return field_of_cells(cells_of_solid(solid, box, 1), box, Basis("SH", 1))


def require_views(views: Views) -> None:
    """Raise InvalidScene if there are too few views for a visual hull."""
    if len(views.pictures) < MIN_VIEWS:
        raise InvalidScene(Problem("views", f"are {len(views.pictures)}", f"{MIN_VIEWS} or more"))


def find_solid(views: Views, box: Points | None, resolution: int) -> tuple[Bits, Points]:
    """Return the visual hull (R, R, R) bool, and its box; `box` None searches the box."""
    targets = KeptTargets(views, ring=None, depths={})
    if box is not None:
        return _carved(views, targets, box, resolution), box
    box = _common_cube(views)
    for _ in range(_ROUNDS):
        solid = _carved(views, targets, box, _SEARCH)
        held, size = np.argwhere(solid), (box[1] - box[0]) / _SEARCH
        low, high = np.maximum(held.min(axis=0) - 1, 0), np.minimum(held.max(axis=0) + 2, _SEARCH)
        box = np.stack([box[0] + low * size, box[0] + high * size])
        if (high - low >= _SEARCH - 2).all():
            break
    return _carved(views, targets, box, resolution), box


def _carved(views: Views, targets: KeptTargets, box: Points, R: int) -> Bits:
    memory.require(f"a hull of {R}^3 cells", _CELL_BYTES * R**3)
    size = (box[1] - box[0]) / R
    met = np.empty((TASKS, R, R, R), np.uint8)
    clear, inside = np.zeros((R,) * 3, np.uint16), np.zeros((R,) * 3, np.uint16)
    for looks, held in prefetched(_silhouette(views, targets, view) for view in range(len(views.pictures))):
        mark_clear(box[0].copy(), size, looks.eye, looks.directions, held, met, clear, inside)
    exact = views.masked and not views.rough
    witnesses = 1 if exact else min(_WITNESSES, max(len(views.pictures) // 2, 1))
    solid = (clear < witnesses) & (inside >= MIN_VIEWS)
    if not solid.any():
        found = (
            "see nothing in common in front of the background"
            if (inside >= MIN_VIEWS).any()
            else "see no part of the box together"
        )
        raise InvalidScene(Problem("views", found, "cameras around one object, in the box"))
    return np.asarray(solid)


def _silhouette(views: Views, targets: KeptTargets, view: int) -> tuple[RayTargets, Bits]:
    """Return the pixels of a view, and whether each may belong to the object."""
    camera = views.cameras.cameras[view]
    scale = max(1, min(camera.width, camera.height) // _EDGE)
    looks, own = targets.of(view, scale=scale, samples=1, keep=True), camera.reduced(scale)
    held = np.zeros((1, own.height, own.width), bool)
    held.flat[looks.pixels] = looks.targets[:, 3] > 0
    return looks, dilated(held).reshape(-1)[looks.pixels]  # pixels next to an object may still belong to it


def _common_cube(views: Views) -> Points:
    """Return a cube (2, 3) around the point that the cameras look at, as large as the widest view of it."""
    eyes = views.cameras.eyes
    centre = views.cameras.looked_at(towards=eyes.mean(axis=0), pull=1e-6)
    away = np.sqrt(np.square(eyes - centre).sum(axis=1))
    wide = [max(camera.width / camera.fx, camera.height / camera.fy) / 2 for camera in views.cameras.cameras]
    half = float((away * np.array(wide)).max())
    return np.stack([centre - half, centre + half])
