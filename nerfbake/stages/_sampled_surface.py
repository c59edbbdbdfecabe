"""The surface of a field as a function in bricks of samples, and the level at which it is cut."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from nerfbake import memory, progress
from nerfbake.errors import InvalidScene, Problem
from nerfbake.kernels.arrays import Bits, Coords, Floats, Points, Singles
from nerfbake.kernels.march.median import march_medians
from nerfbake.kernels.maths.affine import determinant, inverse, length, rotate
from nerfbake.kernels.maths.elementary import power
from nerfbake.kernels.surface.fusion import DepthViews, fuse_depths, sample_opacity
from nerfbake.kernels.surface.samples import CUBE, EDGE, Top, blur, brick_places, least_along_rays, mark_bricks, spread
from nerfbake.scene.camera import Cameras
from nerfbake.scene.radiance_field import RadianceField

_FINEST = 512  # samples along the longest edge
_VIEWS = 50  # most views whose depths are fused
_JUDGES = 10  # views whose silhouettes choose the level
_MOST_PIXELS = 800  # along the longer edge of a picture of depths
_TRUNCATION = 2.0  # lattice steps
_REACH = 3  # samples around the depths that have a brick
_DENSE = 0.15  # opacity of a step that supports a surface
_SUPPORT = 2  # steps: how far a surface may be from what supports it
_LEVELS = 64
_HIDDEN = -0.5  # truncations: a sample so far behind what every view sees is inside
# Of 50 of the chair's training views, silhouettes of 50,000 triangles on 25 others: opacity 34.5 dB, distances 33.9,
# both 35.0, both smoothed 34.1, both half smoothed 34.9 with a ninth of the folded edges.
_DISTANCES = 0.4  # weight of the fused distances, beside opacities of 0 to 1
_BLUR = 0.5
_BRICK_BYTES = 4 * (CUBE * 4 + 3 + CUBE)


@dataclass(frozen=True, eq=False)
class SampledSurface:
    """A function around a surface: below `level` is inside.

    top, places, values  its bricks (kernels.surface.samples)
    dense                (b, 64) bool: samples with something dense within _SUPPORT steps
    world                (3, 4): the world of the lattice
    """

    top: Top
    places: Coords
    values: Singles
    dense: Bits
    level: float
    world: Points

    def supported(self, positions: Floats) -> Bits:
        """(v,) whether there is something dense near each position in the lattice."""
        x, y, z = np.rint(positions).astype(np.int64).T
        brick = self.top[x // EDGE, y // EDGE, z // EDGE]
        held = self.dense[brick, (x % EDGE * EDGE + y % EDGE) * EDGE + z % EDGE]
        return np.asarray(held & (brick >= 0), bool)


def sample_surface(field: RadianceField, cameras: Cameras) -> SampledSurface:
    """Sample the field's surface as the cameras see it. Raises InvalidScene if they see none, MemoryLimit."""
    size = field.box[1] - field.box[0]
    step = 1
    while size.max() > _FINEST * step:
        step *= 2
    margin = _REACH + 1
    low = np.floor(field.box[0]) - margin * step
    shape = (np.ceil(size / step).astype(np.int64) + 2 * margin + EDGE) // EDGE
    lattice = field.place / step
    lattice[:, 3] -= low / step + 0.5
    back = inverse(lattice[:, :3])
    world = np.column_stack([back, -rotate(lattice[:, 3], back)])
    width = float(power(abs(determinant(world[:, :3])), 1 / 3))
    views, alpha = _depths(field, cameras, width)
    held = np.zeros(shape, bool)
    memory.hold("the bricks' grid", 5 * held.size)
    for view in range(len(views.depth)):
        mark_bricks(_own(views, views.depth, view), views.pose[view], views.optics[view], lattice, float(_REACH), held)
    b = int(held.sum())
    if not b:
        raise InvalidScene(Problem("the field", "has no surface that a camera sees", "a dense object in view"))
    memory.hold("the surface's bricks", _BRICK_BYTES * b)
    top = np.full(held.shape, -1, np.int32)
    top[held] = np.arange(b)
    places = brick_places(top)
    fused, nearest, opacity = (np.empty((b, CUBE), np.float32) for _ in range(3))
    fuse_depths(places, world, views, _TRUNCATION * width, fused, nearest)
    progress.report(0.7)
    sample_opacity(places, field.cells, field.densities, low, step, width, opacity)
    # The distances are smooth, but lose thin parts, because views from both sides vote for empty space there. The
    # opacities keep them, but are noisy.
    mixed = np.where(nearest <= _HIDDEN, np.float32(-1), -opacity) + np.float32(_DISTANCES) * fused
    values = np.empty_like(mixed)
    blur(top, places, mixed, _BLUR, values)
    level = _nearest_level(top, values, lattice, views, alpha)
    dense = np.zeros((b, CUBE), bool)
    spread(top, places, opacity >= _DENSE, _SUPPORT, dense)
    return SampledSurface(top, places, values, dense, level, world)


def _depths(field: RadianceField, cameras: Cameras, width: float) -> tuple[DepthViews, Singles]:
    """Median depths and alphas of views that are spread over all cameras, with pixels about as wide as a step."""
    centre = field.world(field.box.mean(axis=0))
    chosen = _spread_views(cameras.eyes)
    own = []
    for number in chosen:
        camera = cameras.cameras[number]
        distance = max(length(camera.pose[:3, 3] - centre), width)
        share = min(distance / (width * camera.fx), _MOST_PIXELS / max(camera.width, camera.height))
        own.append(camera.resized(max(round(camera.width * share), 2), max(round(camera.height * share), 2)))
    H, W = max(camera.height for camera in own), max(camera.width for camera in own)
    memory.hold("the depths", 8 * len(own) * H * W)
    depth, alpha = np.full((len(own), H, W), np.inf, np.float32), np.zeros((len(own), H, W), np.float32)
    pose = np.stack([camera.pose[:3] for camera in own])
    optics = np.array([[camera.fx, camera.fy, camera.cx, camera.cy] for camera in own])
    views = DepthViews(depth, np.array([[camera.height, camera.width] for camera in own]), pose, optics)
    with progress.part(0, 0.5):
        for view in progress.each(range(len(own))):
            seen, covered = np.empty(views.size[view], np.float32), np.empty(views.size[view], np.float32)
            march_medians(field.cells, field.densities, field.box, field.place, pose[view], optics[view], seen, covered)
            depth[view, : len(seen), : seen.shape[1]], alpha[view, : len(seen), : seen.shape[1]] = seen, covered
    return views, alpha


def _spread_views(eyes: Points) -> list[int]:
    """At most _VIEWS views, each as far as possible from those before it."""
    chosen, away = [0], np.full(len(eyes), np.inf)
    while len(chosen) < min(len(eyes), _VIEWS):
        away = np.minimum(away, np.square(eyes - eyes[chosen[-1]]).sum(axis=1))
        away[chosen] = -1
        chosen.append(int(np.argmax(away)))
    return chosen


def _own(views: DepthViews, pictures: Singles, view: int) -> Singles:
    """The part in use of a view's picture."""
    H, W = views.size[view]
    return np.ascontiguousarray(pictures[view, :H, :W])


def _nearest_level(top: Top, values: Singles, lattice: Points, views: DepthViews, alpha: Singles) -> float:
    """The level whose silhouettes have the least squared error from the field's own."""
    least, target = [], []
    for view in range(0, len(alpha), -(-len(alpha) // _JUDGES)):
        found = np.empty(views.size[view], np.float32)
        least_along_rays(top, values, lattice, views.pose[view], views.optics[view], _DISTANCES, found)
        least.append(found.reshape(-1))
        target.append(_own(views, alpha, view).reshape(-1))
    return _best_level(np.concatenate(least), np.concatenate(target).astype(np.float64))


def _best_level(least: Singles, alpha: Floats) -> float:
    """least (m,): the smallest value along each ray, which hits the surface of every level above it."""
    levels = np.linspace(float(least.min()), _DISTANCES, _LEVELS + 1)[1:-1]
    number = np.searchsorted(levels, least, side="left")
    error = np.cumsum(np.bincount(number, weights=1 - 2 * alpha, minlength=len(levels) + 1))[:-1]
    return float(levels[int(np.argmin(error))])
