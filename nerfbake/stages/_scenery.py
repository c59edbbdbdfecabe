"""Where a fit of pictures with scenery starts: the inner cube, shells of fog around it, and a wall at their end."""

from __future__ import annotations

from collections.abc import Collection
from typing import NamedTuple

import numpy as np

from nerfbake import memory
from nerfbake.errors import InvalidScene, Problem
from nerfbake.kernels.arrays import Bits, Floats, Points
from nerfbake.kernels.fit.plan import plan_of_kept
from nerfbake.kernels.maths.affine import rotate
from nerfbake.scene.camera import Camera, Cameras
from nerfbake.scene.views import Views
from nerfbake.stages._bricks import BrickCells, cell_places, cells_of_plan, cells_of_solid, lattice_frame
from nerfbake.stages._depth_map import DepthMap
from nerfbake.stages._scenery_depths import HALF_DIAGONAL, Depths, find_depths, vote
from nerfbake.stages._scenery_points import reach_of

SHELLS = 6  # with the inner cube: the outermost one is 32 times as wide as the inner cube
FOG = 0.01  # density per cell width
_SURFACE = 0.3  # density per cell width where pictures show a surface
WALL = 3.0  # density per cell width of the outermost cells, which show whatever is farther away, such as the sky
_LEAST = 3  # views that must see a cell that is not part of the wall
_CLEAR = 0.25  # of the distance that the cameras look at: no fog starts that close to a camera
_CELL_BYTES = 40
_PLACE_BYTES, _FRAME_BYTES = 96, 32  # per cell, while its place is computed; of its centre and width


class SceneryStart(NamedTuple):
    """The inner cube (2, 3), the cells that a fit starts from, and the depths that pictures show."""

    box: Points
    cells: BrickCells
    depths: Depths


def start_scenery(views: Views, box: Points | None, resolution: int, B: int) -> SceneryStart:
    """Return the inner cube, and the cells that a fit starts from: fog and a wall at its end.

    Fog fills all cells that three views see (all views, if there are fewer), except close to a camera. If the sparse
    points of a picture are about equally far, it fills what this picture alone sees at their distance, and nothing
    before them. Where depth maps show a surface, cells are denser, and there are none where pictures see through. The
    wall is at the end of the outermost shell, on all sides. box: the inner cube; None: around the point that the
    cameras look at. Raises InvalidScene, MemoryLimit.
    """
    box = inner_cube_of(views.cameras) if box is None else box
    with memory.scope():
        solid, surface, depths = _visible(views, box, resolution)
    if not solid.any():
        raise InvalidScene(Problem("views", "see no part of the box together", "cameras that look at the same place"))
    cells = cells_of_solid(solid, box, B, FOG)
    shell, corner = cell_places(cells.bricks)
    _thicken(cells, surface[shell * resolution + corner[:, 0], corner[:, 1], corner[:, 2]], _SURFACE)
    close_wall(cells)
    return SceneryStart(box, cells, depths)


def wall_of(cells: BrickCells) -> Bits:
    """Return the cells (n,) at the end of the outermost shell."""
    shell, corner = cell_places(cells.bricks)
    wide, edge = 1 + (cells.bricks.places & 1)[:, None], 8 * cells.bricks.top.shape[1]
    return np.asarray((shell == SHELLS - 1) & ((corner == 0) | (corner + wide == edge)).any(axis=1))


def close_wall(cells: BrickCells) -> None:
    """Make the wall opaque, so that rays that leave all other cells do not end in the background."""
    _thicken(cells, wall_of(cells), WALL)


def _thicken(cells: BrickCells, chosen: Bits, density: float) -> None:
    """Give the chosen cells (n,) at least this density per cell width."""
    first, values = cells.bricks.first, cells.bricks.values
    D = len(values) // int(first[-1])
    brick = np.repeat(np.arange(len(first) - 1), np.diff(first))[chosen]
    start = first[:-1][brick].astype(np.int64)
    place = D * start + (D - 1) * np.diff(first)[brick] + np.flatnonzero(chosen) - start  # of each density
    values[place] = np.maximum(values[place], np.float32(density))


def focus_distance(views: Views, box: Points) -> float:
    """Return the median distance of the cameras from the middle of the inner cube, but at least half of its edge."""
    return max(_median_distance(views.cameras.eyes, box.mean(axis=0)), float((box[1] - box[0]).mean()) / 2)


def follow_depths(cells: BrickCells, maps: Collection[DepthMap], box: Points) -> BrickCells:
    """Return the cells without those that depth maps show as empty, and denser where they show a surface.

    box: the inner cube. Raises MemoryLimit.
    """
    with memory.scope():
        memory.require(f"places of {cells.n:,} cells", _PLACE_BYTES * cells.n)
        wall = wall_of(cells)
        memory.hold(f"depths of {cells.n:,} cells", _FRAME_BYTES * cells.n)
        votes = vote(maps, *_frames(cells))
    _thicken(cells, votes.surface & ~wall, _SURFACE)
    keep, bricks = wall | ~votes.empty, cells.bricks
    if keep.all() or not keep.any():
        return cells
    return cells_of_plan(bricks, plan_of_kept(bricks.top, bricks.slots, bricks.first, keep), box, cells.B)


def _frames(cells: BrickCells) -> tuple[Points, Floats]:
    """Return the centre (n, 3) and the width (n,) of each cell."""
    shell, corner = cell_places(cells.bricks)
    wide = 1 + (cells.bricks.places & 1)
    centre = cells.bricks.low[shell] + (corner + wide[:, None] / 2) * cells.bricks.size[shell]
    return centre, cells.bricks.width[shell] * wide


def resolved(cells: BrickCells, views: Views) -> Bits:
    """Return the cells (n,) that cover more than one pixel in the nearest view that shows them."""
    centre, width = _frames(cells)
    found = np.zeros(cells.n, bool)
    for camera in views.cameras.cameras:
        away = np.sqrt(np.square(centre - camera.pose[:3, 3]).sum(axis=1))
        found |= (width * max(camera.fx, camera.fy) > away) & sees(camera, centre, width)
    return found


def _visible(views: Views, box: Points, R: int) -> tuple[Bits, Bits, Depths]:
    """Return the cells (S R, R, R) of all shells that the fit starts from, those of them with a surface, and the depths
    that pictures show.
    """
    memory.require(f"fog in {SHELLS} shells of {R}^3 cells", _CELL_BYTES * R**3 * SHELLS)
    low, size, width = lattice_frame(box, R, SHELLS)
    steps = np.stack(np.meshgrid(*[np.arange(R)] * 3, indexing="ij"), axis=-1).reshape(-1, 3) + 0.5
    focus, least = focus_distance(views, box), min(_LEAST, len(views.pictures))
    found, surfaces, clear, reach, depths = [], [], _CLEAR * focus, reach_of(views.cameras), find_depths(views, focus)
    for shell in range(SHELLS):
        centre, counts = low[shell] + steps * size[shell], np.zeros(R**3, np.int32)
        # Where the distance is known, one view is enough. Elsewhere, views whose distance is unknown count.
        near, wide = np.zeros(R**3, bool), np.zeros(R**3, bool)
        for number, camera in enumerate(views.cameras.cameras):
            seen = sees(camera, centre, width[shell])
            counts += seen
            away = np.square(centre - camera.pose[:3, 3]).sum(axis=1)
            counts[away < clear * clear] = -len(views.pictures)
            if reach.near[number] > 0:
                away = np.sqrt(away)
                counts[seen & (away + width[shell] < reach.near[number])] = -len(views.pictures)
                near |= seen & (away - width[shell] < reach.far[number])
            else:
                wide |= seen
        votes = vote(depths.maps.values(), centre, np.full(R**3, width[shell]))
        solid = ((near & (counts >= 1)) | (wide & (counts >= least))) & ~votes.empty
        solid, surface = (solid | votes.surface).reshape(R, R, R), votes.surface.reshape(R, R, R)
        if shell:
            solid[R // 4 : R - R // 4, R // 4 : R - R // 4, R // 4 : R - R // 4] = False
        if shell == SHELLS - 1:  # the wall is closed, so that no view between or beside the others looks out
            wall = np.ones((R, R, R), bool)
            wall[1:-1, 1:-1, 1:-1] = solid[1:-1, 1:-1, 1:-1]
            solid = wall
        found.append(solid)
        surfaces.append(surface)
    return np.concatenate(found), np.concatenate(surfaces), depths


def sees(camera: Camera, centre: Points, width: Floats | float) -> Bits:
    """Return which cells (n,) around these centres may touch the camera's frustum. The lens counts as a pinhole."""
    along = rotate(centre - camera.pose[:3, 3], np.ascontiguousarray(camera.pose[:3, :3].T))
    depth, reach = -along[:, 2], HALF_DIAGONAL * np.asarray(width)
    if camera.lens is not None and camera.lens.all_round:
        return np.ones(len(centre), bool)
    inside = depth > -reach
    for axis, middle, edge, focal in (0, camera.cx, camera.width, camera.fx), (1, camera.cy, camera.height, camera.fy):
        # Picture rows count downwards, so that both sides of the frustum are within +-far.
        far = max(middle, edge - middle) / focal
        inside &= np.abs(along[:, axis]) <= far * depth + reach * np.sqrt(1 + far * far)
    return np.asarray(inside)


def inner_cube_of(cameras: Cameras) -> Points:
    """Return a cube (2, 3) around the point that the cameras look at, as wide as they are away from it.

    Pictures of long lenses show less there: the cube is then as wide as what their longer edges show. Around cameras
    whose pictures show all directions, if there are any.
    """
    eyes = cameras.eyes
    if any(camera.lens is not None and camera.lens.all_round for camera in cameras.cameras):
        return _cube_around(eyes)
    spread = float(np.sqrt(np.square(eyes - eyes.mean(axis=0)).sum(axis=1).max()))
    ahead = (eyes + spread * cameras.axes).mean(axis=0)  # where cameras with parallel axes look at
    centre = cameras.looked_at(towards=ahead, pull=1e-2 * len(eyes))
    slopes = [max(camera.width / camera.fx, camera.height / camera.fy) / 2 for camera in cameras.cameras]
    half = _median_distance(eyes, centre) * min(0.5, float(np.median(slopes)))
    if not half > 0:
        raise InvalidScene(Problem("the cameras", "are all at the same place", "two places or more, or `box`"))
    return np.stack([centre - half, centre + half])


def _cube_around(eyes: Points) -> Points:
    """Return a cube (2, 3) around cameras that look to all sides, half as wide again as they are spread."""
    centre = (eyes.min(axis=0) + eyes.max(axis=0)) / 2
    half = 1.5 * float(np.sqrt(np.square(eyes - centre).sum(axis=1).max()))
    if not half > 0:
        raise InvalidScene(Problem("the cameras", "are all at the same place", "two places or more, or `box`"))
    return np.stack([centre - half, centre + half])


def _median_distance(points: Points, centre: Floats) -> float:
    return float(np.median(np.sqrt(np.square(points - centre).sum(axis=1))))
