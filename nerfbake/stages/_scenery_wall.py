"""The wall at the end of the outermost shell of a fit of scenery: its colours are those that the photographs need.

docs/tuning.md, "The wall", has the measurements.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from nerfbake import memory
from nerfbake.kernels.arrays import Floats, Points
from nerfbake.kernels.fit.bricks import values_by_brick, values_by_cell
from nerfbake.kernels.maths.elementary import log
from nerfbake.scene.basis import SH0, Basis
from nerfbake.scene.brick_field import BrickField
from nerfbake.scene.views import Views
from nerfbake.stages._bricks import BrickCells, cell_places, field_of_cells
from nerfbake.stages._ray_targets import reduced_view
from nerfbake.stages._scenery import wall_of
from nerfbake.stages.field_to_image import render_field
from nerfbake.stages.scene_to_field import build_field_from_bricks

_OPAQUE = 6.0  # density per cell width, so that the colour behind the wall does not shine through
_EDGE = 96  # most pixels of a picture's shorter edge
_SHOWN = 0.1  # least transmittance before the wall of a pixel that tells its colour
_HIDDEN = 1e-3  # weight of the colour of other pixels, for directions in which no pixel tells more
_PIXELS = 1.0  # least weight of a cell whose colour is its own
_PATCHES = 8  # along each axis of each side of the wall: their colours spread to cells that no photograph shows
_BLUR = 1e-3  # of the cosine of an angle, within which patches count about equally
_TOGETHER = 1024  # cells at a time, so that temporaries stay in the cache
_FAINT, _BRIGHT = 0.02, 0.98  # range of colours
_CELL_BYTES = 100


def settle_wall(cells: BrickCells, views: Views, box: Points, gains: Floats) -> None:
    """Give each cell of the wall one opaque colour: the mean that the photographs show there.

    A cell that no photograph shows gets the colours of those around. gains: of each view, or none.
    """
    wall = np.flatnonzero(wall_of(cells))
    with memory.scope():
        memory.require(f"the colours of {len(wall):,} cells", _CELL_BYTES * len(wall) + 8 * len(cells.bricks.values))
        logits = _colours(cells, wall, views, box, gains)
        rows = np.empty((cells.n, 3 * cells.B + 1), np.float32)
        values_by_cell(cells.bricks.values, cells.bricks.first, rows)
        rows[wall, :-1] = 0
        rows[wall, : -1 : cells.B] = logits / SH0
        rows[wall, -1] = np.maximum(rows[wall, -1], np.float32(_OPAQUE))
        values_by_brick(rows, cells.bricks.first, cells.bricks.values)


def _colours(cells: BrickCells, wall: npt.NDArray[np.intp], views: Views, box: Points, gains: Floats) -> Floats:
    """Return the colours (n, 3) of the cells of the wall, before the sigmoid."""
    number, toward = _lattice(cells, wall)
    low, size, edge = cells.bricks.low[-1], cells.bricks.size[-1], 8 * cells.bricks.top.shape[1]
    before = build_field_from_bricks(_without(cells, wall, box))
    patch = _patches(toward)
    own, spread = np.zeros((len(wall), 4)), np.zeros((6 * _PATCHES**2, 4))
    for view, camera in enumerate(views.cameras.cameras):
        factor = -(-min(camera.width, camera.height) // _EDGE)
        camera, target = reduced_view(views, view, factor)
        image = render_field(before, camera, background=None)
        eye, looks = camera.rays()
        used = (target[..., 3] >= 1).ravel()
        through = (1 - image.alpha).ravel().astype(np.float64)[used]
        wanted = target[..., :3].reshape(-1, 3)[used] / (gains[view] if len(gains) else 1.0)
        rest = wanted - image.colour.reshape(-1, 3)[used]
        place = _leaving(eye, looks[used], low, size, edge)
        cell = number[place[:, 0], place[:, 1], place[:, 2]]
        shown = through > _SHOWN
        colour = np.clip(np.where(shown[:, None], rest / np.maximum(through, _SHOWN)[:, None], wanted), 0, 1)
        for totals, where, weight in ((own, cell, through * shown), (spread, patch[cell], through * shown + _HIDDEN)):
            totals[:, 3] += np.bincount(where, weight, len(totals))
            for channel in range(3):
                totals[:, channel] += np.bincount(where, weight * colour[:, channel], len(totals))
    colours = _blended(toward, own, spread)
    colours = np.clip(colours, _FAINT, _BRIGHT)
    return log(colours / (1 - colours))


def _without(cells: BrickCells, wall: npt.NDArray[np.intp], box: Points) -> BrickField:
    """Return the cells without those of the wall."""
    field = field_of_cells(cells, box, Basis("SH", cells.B))
    field.values[wall, -1] = 0
    return field


def _lattice(cells: BrickCells, wall: npt.NDArray[np.intp]) -> tuple[npt.NDArray[np.int32], Floats]:
    """Return the place of each cell in `wall`, on the lattice (R, R, R) of the outermost shell, and its direction.

    Directions (n, 3) are from the middle of the shells to the cells, as long as the largest coordinate is 1.
    """
    edge = 8 * cells.bricks.top.shape[1]
    corner, wide = cell_places(cells.bricks)[1][wall], 1 + (cells.bricks.places[wall] & 1)
    number = np.zeros((edge, edge, edge), np.int32)
    for x, y, z in np.ndindex(2, 2, 2):
        some = np.flatnonzero((wide > 1) | (x + y + z == 0))
        number[corner[some, 0] + x, corner[some, 1] + y, corner[some, 2] + z] = some
    toward = (corner + wide[:, None] / 2) / (edge / 2) - 1
    return number, toward / np.abs(toward).max(axis=1, keepdims=True)


def _leaving(eye: Points, looks: Floats, low: Points, size: Points, edge: int) -> npt.NDArray[np.int64]:
    """Return the cells (m, 3) of the lattice through which rays leave it."""
    start = (eye - low) / size
    steps = np.where(looks == 0, 1e-300, looks) / size
    ends = np.where(steps > 0, edge, 0)
    away = ((ends - start) / steps).min(axis=1)
    return np.asarray(np.clip(np.floor(start + away[:, None] * steps), 0, edge - 1), np.int64)


def _patches(toward: Floats) -> npt.NDArray[np.int64]:
    """Return the patch (n,) of the wall's six sides in each direction (n, 3) whose largest coordinate is 1."""
    axis = np.abs(toward).argmax(axis=1)
    rows = np.arange(len(toward))
    side = 2 * axis + (toward[rows, axis] > 0)
    a, b = (
        np.clip((toward[rows, (axis + step) % 3] + 1) / 2 * _PATCHES, 0, _PATCHES - 1).astype(np.int64)
        for step in (1, 2)
    )
    return np.asarray((side * _PATCHES + a) * _PATCHES + b, np.int64)


def _blended(toward: Floats, own: Floats, spread: Floats) -> Floats:
    """Return a colour (n, 3) for each direction: its own, or that of the patches in about the same direction."""
    colours = own[:, :3] / np.maximum(own[:, 3:], 1e-9)
    patch = _patches(toward)
    unit = toward / np.sqrt(np.square(toward).sum(axis=1, keepdims=True))
    filled = np.flatnonzero(spread[:, 3] > 0)
    sums = np.stack([np.bincount(patch, unit[:, axis], len(spread)) for axis in range(3)], axis=1)[filled]
    middle = sums / np.sqrt(np.square(sums).sum(axis=1, keepdims=True))
    sure, shown = np.minimum(spread[filled, 3], _PIXELS), spread[filled, :3] / spread[filled, 3:]
    few = np.flatnonzero(own[:, 3] < _PIXELS)
    for start in range(0, len(few), _TOGETHER):
        some = few[start : start + _TOGETHER]
        away = 1 + _BLUR - sum(unit[some, axis, None] * middle[:, axis] for axis in range(3))
        weight = sure / (away * away * away)
        weight /= weight.sum(axis=1, keepdims=True)
        near = np.stack([(weight * shown[:, channel]).sum(axis=1) for channel in range(3)], axis=1)
        colours[some] = (own[some, :3] + (_PIXELS - own[some, 3:]) * near) / _PIXELS
    return colours
