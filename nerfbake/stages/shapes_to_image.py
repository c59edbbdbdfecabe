"""Furniture in a textured room -> photographs whose cameras, colours and depths are known exactly.

The room is ROOM in metres, z up. A table with four things stands at its centre, and furniture stands along the walls.
Rays meet planes, boxes and balls where their equations say. Every surface has two colours, which are mixed by value
noise: smooth random blobs of three sizes in space. No surface shines, so each looks the same from all sides.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake.errors import InvalidScene, Problem
from nerfbake.kernels.arrays import Floats, Ints, Points
from nerfbake.kernels.maths.elementary import sine_cosine
from nerfbake.scene.camera import Camera, Cameras, look_at
from nerfbake.scene.image import WHITE, Image
from nerfbake.stages._supersampled import supersampled

ROOM = np.array([[-2.6, -2.3, 0.0], [2.6, 2.3, 2.5]])  # two opposite corners
FOCUS, DISTANCE = np.array([0.0, 0.0, 0.85]), 1.25  # what the cameras look at, and how far away they are
FIELD_OF_VIEW = np.radians(60)  # horizontally, like a phone's
_TURN = np.radians(15)  # between neighbouring cameras, unless they would turn by more than a circle
_LOW, _HIGH = np.radians(21), np.radians(28)  # the cameras' elevations
_SMALL, _LARGE = 0.4, 1.0  # blobs of the things on the table, and of the rest
_BLOBS = (0.37, 0.15, 0.06)  # metres: edges of the cells of the noise
_CONTRAST = 2.0  # the mean of three uniform numbers is mostly near 0.5
_LIGHT = np.array([0.36, -0.48, 0.8])  # unit, towards the light
_RAY_BYTES = 310  # per ray while it is traced (299 measured)
_NOISY = 1 << 14  # points whose noise is computed at a time: temporaries stay in the cache

# Opposite corners of boxes: a table and its foot, a cupboard, a shelf, a bench and a stool; a parcel and a book.
_BOXES = np.array(
    [
        [[-0.45, -0.36, 0.68], [0.45, 0.36, 0.74]],
        [[-0.3, -0.22, 0.0], [0.3, 0.22, 0.68]],
        [[-2.5, 1.2, 0.0], [-1.9, 2.2, 1.7]],
        [[1.2, 1.9, 1.1], [2.4, 2.3, 1.18]],
        [[1.9, -1.5, 0.0], [2.5, 0.5, 0.45]],
        [[-1.0, -2.1, 0.0], [-0.5, -1.6, 0.5]],
        [[-0.32, 0.0, 0.74], [-0.08, 0.19, 1.02]],
        [[-0.2, -0.29, 0.74], [0.05, -0.12, 0.79]],
    ]
)
# Balls: two on the table, one on the shelf, one on the floor.
_CENTRES = np.array([[0.13, 0.02, 0.9], [0.3, -0.22, 0.82], [1.7, 2.1, 1.33], [-1.6, -0.9, 0.25]])
_RADII = np.array([0.16, 0.08, 0.15, 0.25])
# Surfaces are numbered: six walls (low and high x, y, z), the boxes, the balls.
_SURFACES = 6 + len(_BOXES) + len(_CENTRES)
_SIZES = np.where(np.isin(np.arange(_SURFACES), [12, 13, 14, 15]), _SMALL, _LARGE)

Keys = npt.NDArray[np.uint32]


class _Paint(NamedTuple):
    """dark and light (surfaces, 3): the colours of each surface in sRGB. layer (surfaces,): seed of its noise."""

    dark: Floats
    light: Floats
    layer: Keys


class _Hits(NamedTuple):
    """Where rays (m,) meet the first surface: its distance, its number, and its normal (3, m)."""

    distance: Floats
    surface: Ints
    normal: Floats


def orbit_room(*, frames: int, width: int, height: int) -> Cameras:
    """Return cameras at the height of a hand on an arc around the table, which they look at.

    They go along the arc at a low height, 15 degrees apart, and come back between these places at a greater height.
    More than 48 cameras go all around the table.

    >>> from nerfbake import orbit_room
    >>> print(orbit_room(frames=3, width=16, height=12))
    3 cameras
    """
    if not 1 <= frames <= 10_000:
        raise InvalidScene(Problem("frames", f"are {frames:,}", "1 to 10,000"))
    there = np.arange((frames + 1) // 2)
    back = there[len(there) - frames // 2 :][::-1] - 0.5
    turns = min(_TURN, 2 * np.pi / len(there)) * np.concatenate([there, back])
    heights = [_LOW] * len(there) + [_HIGH] * len(back)
    poses = [look_at(FOCUS, turn, height, DISTANCE) for turn, height in zip(turns, heights, strict=True)]
    sine, cosine = (float(part) for part in sine_cosine(FIELD_OF_VIEW / 2))
    focal = 0.5 * width * cosine / sine
    return Cameras(tuple(Camera(width, height, focal, pose, f"{i:04d}") for i, pose in enumerate(poses)))


def render_room(camera: Camera, *, seed: int = 0, samples: int = 1) -> Image:
    """Return the picture of the room from a camera in it, with samples x samples rays a pixel.

    Colours and depths are exact. seed selects the colours and the noise of all surfaces; the shapes are always the
    same. The same arguments give the same bytes. Raises InvalidScene for a camera outside the room, MemoryLimit.

    >>> from nerfbake import orbit_room, render_room
    >>> image = render_room(orbit_room(frames=1, width=16, height=12).cameras[0])
    >>> image.size, float(image.alpha.min())
    ((16, 12), 1.0)
    """
    place = camera.pose[:3, 3]
    if not ((ROOM[0] < place) & (place < ROOM[1])).all():
        found, (low, high) = _point_text(place), map(_point_text, ROOM)
        raise InvalidScene(Problem(f"camera {camera.name}".strip(), f"is at {found}", f"between {low} and {high}"))
    random = np.random.default_rng(seed)
    colour = random.uniform(0.3, 0.75, (_SURFACES, 3))
    paint = _Paint(0.45 * colour, 1.25 * colour, random.integers(0, 1 << 32, _SURFACES, np.uint32))
    return supersampled(lambda part: _traced(part, paint), camera, samples)


def _point_text(point: Floats) -> str:
    return ", ".join(f"{value:g}" for value in point)


def _traced(camera: Camera, paint: _Paint) -> Image:
    """Render with one ray per pixel."""
    camera.require_memory(_RAY_BYTES)
    origin, looks = camera.rays()
    directions = np.ascontiguousarray(looks.T)
    hits = _meet(origin, directions)
    places = (origin[:, None] + hits.distance * directions) / _SIZES[hits.surface]
    share, layer = np.empty(len(looks)), paint.layer[hits.surface]
    for start in range(0, len(looks), _NOISY):
        some = slice(start, start + _NOISY)
        share[some] = _noise(places[:, some], layer[some])
    lit = 0.75 + 0.25 * (hits.normal * _LIGHT[:, None]).sum(axis=0)
    colour = np.empty((len(looks), 3), np.float32)
    for channel in range(3):
        dark, light = paint.dark[hits.surface, channel], paint.light[hits.surface, channel]
        colour[:, channel] = lit * (dark + share * (light - dark))
    shape = camera.height, camera.width
    depth = hits.distance.astype(np.float32).reshape(shape)
    return Image(colour.reshape(*shape, 3), np.ones(shape, np.float32), depth, WHITE)


def _meet(origin: Floats, directions: Floats) -> _Hits:
    """Find the first surface along each ray: an origin (3,) inside the room, and unit directions (3, m)."""
    reciprocal = 1 / np.where(directions == 0, 1e-300, directions)  # finite, so that no product is NaN
    rows = np.arange(directions.shape[1])
    _, leave = _through(ROOM, origin, reciprocal)
    axis = leave.argmin(axis=0)
    hits = _Hits(leave[axis, rows], 2 * axis + (directions[axis, rows] > 0), np.zeros(directions.shape))
    hits.normal[axis, rows] = -np.sign(directions[axis, rows])
    for number, box in enumerate(_BOXES, start=6):
        enter, leave = _through(box, origin, reciprocal)
        near = enter.max(axis=0)
        met = np.flatnonzero((near > 0) & (near < leave.min(axis=0)) & (near < hits.distance))
        axis = enter[:, met].argmax(axis=0)
        hits.distance[met], hits.surface[met], hits.normal[:, met] = near[met], number, 0
        hits.normal[axis, met] = -np.sign(directions[axis, met])
    for number, (centre, radius) in enumerate(zip(_CENTRES, _RADII, strict=True), start=6 + len(_BOXES)):
        away = origin - centre
        middle = -(directions * away[:, None]).sum(axis=0)  # of the chord, as a distance along the ray
        half = middle * middle - (away * away).sum() + radius * radius  # of the chord, squared
        near = middle - np.sqrt(np.maximum(half, 0))
        met = np.flatnonzero((half > 0) & (near > 0) & (near < hits.distance))
        hits.distance[met], hits.surface[met] = near[met], number
        hits.normal[:, met] = (away[:, None] + near[met] * directions[:, met]) / radius
    return hits


def _through(box: Points, origin: Floats, reciprocal: Floats) -> tuple[Floats, Floats]:
    """Return the distances (3, m) at which rays enter and leave the slab of a box along each axis."""
    low, high = (box - origin)[:, :, None] * reciprocal
    return np.minimum(low, high), np.maximum(low, high)


def _noise(places: Floats, layer: Keys) -> Floats:
    """Return value noise (m,) in 0..1 at places (3, m): the mean over blobs of all sizes, with more contrast.

    The value at each corner of a grid is a hash of its coordinates and of the layer (m,). Values between the corners
    are interpolated smoothly.
    """
    total = np.zeros(places.shape[1])
    for number, edge in enumerate(_BLOBS):
        low = np.floor(places / edge)
        share = places / edge - low
        share = share * share * (3 - 2 * share)
        corner = low.astype(np.int64).astype(np.uint32)  # negative coordinates wrap
        for x, y, z in np.ndindex(2, 2, 2):
            key = (corner[0] + np.uint32(x)) * np.uint32(0x9E3779B1)
            key ^= (corner[1] + np.uint32(y)) * np.uint32(0x85EBCA77)
            key ^= (corner[2] + np.uint32(z)) * np.uint32(0xC2B2AE3D)
            weight = share[0] if x else 1 - share[0]
            weight = weight * (share[1] if y else 1 - share[1])
            total += weight * (share[2] if z else 1 - share[2]) * _hash(key + layer + np.uint32(number))
    return np.asarray(np.clip(0.5 + _CONTRAST * (total / len(_BLOBS) - 0.5), 0, 1))


def _hash(key: Keys) -> Floats:
    """Return a number in 0..1 for each 32-bit key: the finalizer of MurmurHash3 (Appleby, 2011)."""
    for shift, factor in ((16, 0x85EBCA6B), (13, 0xC2B2AE35)):
        key = (key ^ (key >> np.uint32(shift))) * np.uint32(factor)
    return (key ^ (key >> np.uint32(16))) / np.float64(1 << 32)
