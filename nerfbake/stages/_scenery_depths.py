"""Depths that photographs with scenery show, by comparing neighbouring ones, and what they say about cells of a fit.

docs/tuning.md, "Depths before the fit", has the measurements.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake import memory
from nerfbake.kernels.arrays import Bits, Floats, Points, Singles
from nerfbake.kernels.fit.stereo import compare_planes, smooth_costs
from nerfbake.kernels.maths.affine import rotate
from nerfbake.kernels.parallel import cores, over_chunks
from nerfbake.scene.camera import Camera, Cameras
from nerfbake.scene.views import Views
from nerfbake.stages._depth_map import DepthMap
from nerfbake.stages._ray_targets import reduced_view
from nerfbake.stages._scenery_points import LEAST_POINTS, reach_of
from nerfbake.stages._scenery_sky import distance_within, find_sky, upward
from nerfbake.stages.overlap import Overlap, neighbours

_EDGE, _EDGE_OF_MANY, _MANY = 128, 96, 32  # most pixels of a picture's shorter edge; with more views than _MANY
_LEAST_EDGE = 64  # in smaller pictures, the pixels that are compared reach across too much
_PLANES = 24, 128  # least and most planes
_ALIKE = 0.5  # least cross-correlation of a depth that counts
_STEPS, _SAME = 1.5, 0.015  # depths of two pictures are the same within so many planes, or this share of them
_MARGIN = 0.03  # share of a depth within which the surface lies
_NEAREST = 0.7  # of the distances of points: nearer planes are not tried
_SOUND = 0.02  # quantile of the distances of a picture's points: nearer ones may be wrong
_CLOSE = 0.25  # the same without points, of the distance that the cameras look at
_CORRECTIONS = 6  # of a place in a photograph, until it is the one that a pinhole shows elsewhere
_LEAST_VIEWS = 5  # fewer ones that are far apart agree as little as ones with wrong poses
_LEAST_ALIKE = 0.1  # share of all pixels; with fewer ones, there is too little texture to tell whether poses are right
_CONFIRMED = 0.12  # of the pixels that look alike, the least share whose depth is confirmed unless a picture is alone
_PIXEL_BYTES = 28  # a picture in grey, two depth maps, and the sky
_CELLS, _VOTE_BYTES = 1 << 14, 240  # cells that a core looks at in all maps at a time; for each of them
HALF_DIAGONAL = 0.87  # of a cell of width 1
_FAR_STEPS = 3  # of a depth that is known; farther surfaces lie between the last few planes


class _Picture(NamedTuple):
    """A picture (H, W) in grey as a pinhole shows it, its pixels that are used, and those that may show the sky."""

    camera: Camera
    grey: Singles
    used: Bits
    sky: Bits


class Depths(NamedTuple):
    """What pictures show together: the maps of those that share a depth with others, by their numbers in order, and how
    much all of them do.
    """

    maps: dict[int, DepthMap]
    overlap: Overlap


class Votes(NamedTuple):
    """What depth maps say about cells (n,): which ones are empty, and in which ones a surface lies."""

    empty: Bits
    surface: Bits


def find_depths(views: Views, focus: float) -> Depths:
    """Return the depth maps of the views that have neighbours, or none for small pictures.

    focus: the distance that the cameras look at. Raises MemoryLimit.
    """
    cameras = views.cameras.cameras
    edge = min(min(camera.width, camera.height) for camera in cameras)
    ranges = [_distances(views.cameras, number, focus) for number in range(len(cameras))]
    near, shares = zip(*(neighbours(cameras, number, ranges[number][1]) for number in range(len(cameras))), strict=True)
    alone, share = {number for number, others in enumerate(near) if not others}, sum(shares) / len(cameras)
    if edge < _LEAST_EDGE:
        return Depths({}, Overlap(share, None, tuple(alone)))
    factor = -(-edge // (_EDGE if len(cameras) <= _MANY else _EDGE_OF_MANY))
    pixels = sum(-(-camera.width // factor) * -(-camera.height // factor) for camera in cameras)
    memory.hold(f"depths of {len(cameras)} pictures", _PIXEL_BYTES * pixels)
    up, far = upward(views.cameras), reach_of(views.cameras).far
    pictures = [
        _without_lens(*reduced_view(views, number, factor), up if np.isinf(far[number]) else None)
        for number in range(len(cameras))
    ]
    ends = [(1 / ranges[number][0], 1 / float(far[number])) for number in range(len(cameras))]
    swept = [_swept(pictures, number, near[number], ends[number]) for number in range(len(cameras))]
    made, alike, agreed = dict[int, DepthMap](), 0, 0
    for number, own in enumerate(swept):
        others = [swept[other] for other in near[number]]
        if own is None or not any(other is not None for other in others):
            continue
        agreeing = np.zeros(own.known.shape, np.int32)
        for other in others:
            if other is not None:
                agreeing += _agrees(own, other)
        known = own.known & (agreeing >= min(2, len(others)))
        if own.known.sum() >= _LEAST_ALIKE * known.size and known.sum() < _CONFIRMED * own.known.sum():
            alone.add(number)
        alike, agreed = alike + int(own.known.sum()), agreed + int(known.sum())
        sky = distance_within(pictures[number].sky, known)
        known &= sky == 0
        if known.any() or sky.any():
            inverse = np.where(sky > 0, -np.inf, _filled(own.inverse, known))
            made[number] = own._replace(inverse=inverse, known=known, sky=sky)
    enough = len(cameras) >= _LEAST_VIEWS and alike >= _LEAST_ALIKE * pixels
    return Depths(made, Overlap(share, agreed / alike if enough else None, tuple(sorted(alone))))


def vote(maps: Collection[DepthMap], centre: Points, widths: Floats) -> Votes:
    """Return what the maps say about cells of these widths (n,) around these centres (n, 3).

    A surface lies in a cell if at least a third of the views that know the depth there see it in the cell, or if none
    of them knows it, but the pixels around suggest it. Raises MemoryLimit.
    """
    at_a_time = min(len(centre), cores() * _CELLS)
    memory.require(f"depths of {at_a_time:,} cells at a time", 2 * len(centre) + _VOTE_BYTES * at_a_time)
    empty, surface = np.empty(len(centre), bool), np.empty(len(centre), bool)

    def count(begin: int, end: int) -> None:
        empty[begin:end], surface[begin:end] = _vote(maps, centre[begin:end], widths[begin:end])

    over_chunks(count, len(centre), _CELLS)
    return Votes(empty, surface)


def _vote(maps: Collection[DepthMap], centre: Points, widths: Floats) -> Votes:
    through, at = (np.zeros(len(centre), np.int32) for _ in range(2))
    shown, guessed = (np.zeros(len(centre), bool) for _ in range(2))
    for camera, inverse, known, step, sky in maps:
        along = rotate(centre - camera.pose[:3, 3], np.ascontiguousarray(camera.pose[:3, :3].T))
        depth = -along[:, 2]
        ahead = np.maximum(depth, 1e-9)
        column = np.floor(camera.fx * along[:, 0] / ahead + camera.cx)
        row = np.floor(camera.cy - camera.fy * along[:, 1] / ahead)
        inside = (depth > 0) & (column >= 0) & (row >= 0) & (column < camera.width) & (row < camera.height)
        cells = np.flatnonzero(inside)
        pixel = row[cells].astype(np.int64), column[cells].astype(np.int64)
        surface, sure, depth, width = inverse[pixel], known[pixel], depth[cells], widths[cells]
        # The whole cell is before the sky.
        clear = sky[pixel] * depth > HALF_DIAGONAL * width * max(camera.fx, camera.fy)
        margin = np.maximum(_MARGIN * surface, step / 2)
        before = 1 / (depth + width) > surface + margin
        behind = 1 / np.maximum(depth - width, 1e-9) < surface - margin
        within, near = ~before & ~behind, surface > _FAR_STEPS * step
        through[cells] += before & sure | clear
        at[cells] += within & sure
        shown[cells] |= within & sure & near
        guessed[cells] |= within & ~sure & near
    empty = (through > 2 * at) & (through > 0)
    return Votes(empty, ~empty & shown | (through == 0) & guessed)


def _distances(cameras: Cameras, number: int, focus: float) -> tuple[float, float]:
    """Return the distance of the nearest plane of a picture, and that of what it mostly shows."""
    points, camera = cameras.points, cameras.cameras[number]
    if points is not None:
        seen = points.positions[points.point[points.camera == number]]
        depth = np.sort(-rotate(seen - camera.pose[:3, 3], np.ascontiguousarray(camera.pose[:3, :3].T))[:, 2])
        depth = depth[depth > 0]
        if len(depth) >= LEAST_POINTS:
            return _NEAREST * float(depth[int(_SOUND * (len(depth) - 1))]), float(depth[len(depth) // 2])
    return _CLOSE * focus, focus


def _swept(pictures: list[_Picture], number: int, near: list[int], ends: tuple[float, float]) -> DepthMap | None:
    """Return the depths on which a picture and its neighbours are most alike; those that are alike are `known`.

    ends: inverse depths of the nearest and of the farthest plane.
    """
    if not near:
        return None
    camera, grey, used, _ = pictures[number]
    turn, moves, turns, shift = camera.pose[:3, :3], [], [], 0.0
    fx, fy, cx, cy = camera.fx, camera.fy, camera.cx, camera.cy
    lift = np.array([[1 / fx, 0, -cx / fx], [0, -1 / fy, cy / fy], [0, 0, -1]])
    for other in (pictures[k].camera for k in near):
        lower = np.array([[other.fx, 0, -other.cx], [0, -other.fy, -other.cy], [0, 0, -1]])
        back = np.ascontiguousarray(other.pose[:3, :3].T)
        between = camera.pose[:3, 3] - other.pose[:3, 3]
        turns.append(_product(_product(lower, back), _product(turn, lift)))
        moves.append(rotate(rotate(between, back), lower))
        shift = max(shift, other.fx * float(np.sqrt(np.square(between).sum())) * (ends[0] - ends[1]))
    count = int(min(max(shift, _PLANES[0]), _PLANES[1]))
    memory.require(f"{count} planes of {grey.shape[1]}x{grey.shape[0]} pixels", 16 * count * grey.size)
    step = (ends[0] - ends[1]) / (count - 1)
    planes = ends[1] + step * np.arange(count, dtype=np.float64)
    others, seen = np.stack([pictures[k].grey for k in near]), np.stack([pictures[k].used for k in near])
    alike = np.empty((count, *grey.shape), np.float32)
    compare_planes(grey, others, seen, np.stack(turns), np.stack(moves), planes, alike)
    alike = np.ascontiguousarray(alike.transpose(1, 2, 0))
    totals = smooth_costs(1 - np.maximum(alike, np.float32(0)))
    best = totals.argmin(axis=2)
    inner = np.clip(best, 1, count - 2)
    low, middle, high = (_taken(totals, inner + side).astype(np.float64) for side in (-1, 0, 1))
    bend = low - 2 * middle + high
    offset = np.where((bend > 0) & (best == inner), (low - high) / np.maximum(2 * bend, 1e-9), 0)
    inverse = ends[1] + step * (best + np.clip(offset, -0.5, 0.5))
    return DepthMap(camera, inverse, (_taken(alike, best) > _ALIKE) & used, step, np.zeros(grey.shape, np.float32))


def _product(a: Floats, b: Floats) -> Floats:
    return np.asarray(sum(a[:, k, None] * b[k] for k in range(3)), np.float64)


def _taken(values: Singles, planes: npt.NDArray[np.intp]) -> Singles:
    return np.asarray(np.take_along_axis(values, planes[..., None], axis=2)[..., 0])


def _agrees(own: DepthMap, other: DepthMap) -> Bits:
    """Return the pixels (H, W) whose place has the same depth in another map."""
    camera, seen = own.camera, other.camera
    x, y = camera.slopes() or (np.zeros(0), np.zeros(0))
    looks = np.stack(np.broadcast_arrays(x, y[:, None], -1.0), axis=-1)
    # Homogeneous coordinates, because a depth may be infinite.
    eye = own.inverse[..., None] * (camera.pose[:3, 3] - seen.pose[:3, 3])
    along = rotate(rotate(looks, camera.pose[:3, :3]) + eye, np.ascontiguousarray(seen.pose[:3, :3].T))
    ahead = np.maximum(-along[..., 2], 1e-9)
    column = np.floor(seen.fx * along[..., 0] / ahead + seen.cx)
    row = np.floor(seen.cy - seen.fy * along[..., 1] / ahead)
    inside = (along[..., 2] < 0) & (column >= 0) & (row >= 0) & (column < seen.width) & (row < seen.height)
    place = np.where(inside, row, 0).astype(np.int64), np.where(inside, column, 0).astype(np.int64)
    there = other.inverse[place]
    return np.asarray(inside & (np.abs(own.inverse / ahead - there) <= np.maximum(_STEPS * own.step, _SAME * there)))


def _filled(values: Floats, known: Bits) -> Floats:
    """Return inverse depths (H, W) in which unknown ones are those of the farthest known places around.

    A place whose depth is unknown is mostly hidden in the neighbours, by something nearer.
    """
    height, width = values.shape
    if known.all() or height == width == 1:
        return values
    edges = ((0, height % 2), (0, width % 2))
    held = np.pad(np.where(known, values, np.inf), edges, constant_values=np.inf)
    held = np.minimum(np.minimum(held[::2, ::2], held[::2, 1::2]), np.minimum(held[1::2, ::2], held[1::2, 1::2]))
    some = held < np.inf
    coarse = _filled(np.where(some, held, 0.0), some)
    wide = coarse.repeat(2, axis=0).repeat(2, axis=1)[:height, :width]
    return np.where(known, values, wide)


def _without_lens(camera: Camera, image: Singles, up: Floats | None) -> _Picture:
    """Return a picture (H, W, 4) as a pinhole would show it. up: None if it shows no sky."""
    grey = (image[..., 0] + image[..., 1] + image[..., 2]) * np.float32(1 / 3)
    used = image[..., 3] >= 1
    sky = np.zeros_like(used) if up is None else find_sky(camera, image, up)
    if not camera.bends:
        return _Picture(camera, grey, used, sky)
    plane = camera.plane()
    straight = replace(camera, lens=None)
    if plane is None:  # wider than half of all directions
        return _Picture(straight, grey, np.zeros_like(used), np.zeros_like(used))
    height, width = grey.shape
    y, x = np.mgrid[:height, :width].astype(np.float64)
    # The pixel of the photograph that shows what a pinhole shows at x, y, by repeated correction.
    shown = camera.fx * plane[..., 0] + camera.cx - 0.5, camera.fy * plane[..., 1] + camera.cy - 0.5
    column, row = x.copy(), y.copy()
    for _ in range(_CORRECTIONS):
        error = x - _interpolated(shown[0], column, row), y - _interpolated(shown[1], column, row)
        column, row = np.clip(column + error[0], -9, width + 9), np.clip(row + error[1], -9, height + 9)
    inside = (column >= 0) & (row >= 0) & (column <= width - 1) & (row <= height - 1)
    nearest = tuple(
        np.clip(np.rint(place), 0, most - 1).astype(np.int64) for place, most in ((row, height), (column, width))
    )
    straightened = _interpolated(grey, column, row).astype(np.float32)
    return _Picture(straight, straightened, inside & used[nearest], inside & sky[nearest])


def _interpolated(values: npt.NDArray[np.floating], column: Floats, row: Floats) -> Floats:
    """Return bilinear values of (H, W) at these places, which are moved into the picture."""
    height, width = values.shape
    column, row = np.clip(column, 0, width - 1), np.clip(row, 0, height - 1)
    i, j = np.minimum(column.astype(np.int64), max(width - 2, 0)), np.minimum(row.astype(np.int64), max(height - 2, 0))
    across, down = column - i, row - j
    right, low = np.minimum(i + 1, width - 1), np.minimum(j + 1, height - 1)
    upper = values[j, i] * (1 - across) + values[j, right] * across
    lower = values[low, i] * (1 - across) + values[low, right] * across
    return np.asarray(upper * (1 - down) + lower * down, np.float64)
