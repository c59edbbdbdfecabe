"""Objects of thin parts, studs and gloss -> photographs whose cameras, colours and depths are known exactly.

Both objects are about two world units wide, z up. A lamp casts shadows, and what is glossy mirrors it and the sky, so
that highlights move with the camera. In pictures of 400x400 a world unit has about 125 pixels:

    struts    a crane of rods of 1 to 3 pixels, a wheel with spokes, and a cage of wires around boxes
    bricks    a house of bricks with 2,300 studs; its inside shows through windows and a roof of beams only
"""

from __future__ import annotations

from functools import cache

import numpy as np

from nerfbake.errors import InvalidScene, Problem
from nerfbake.kernels.arrays import Floats, Points
from nerfbake.kernels.maths.elementary import sine_cosine
from nerfbake.kernels.surface.solids import SolidGrid, Solids, grid_of, trace_solids
from nerfbake.scene.camera import Camera, Cameras, look_from
from nerfbake.scene.image import Image
from nerfbake.stages._supersampled import supersampled

OBJECTS = ("struts", "bricks")
FIELD_OF_VIEW, DISTANCE = 0.6911112, 4.0  # as in NeRF-Synthetic
FOCUS = np.array([0.0, 0.0, 0.5])
_LAMP = np.array([0.48, -0.36, 0.8])  # unit, towards the lamp
_RAY_BYTES = 100  # per ray while it is traced
_PALETTE = np.array(
    [[0.85, 0.65, 0.1], [0.75, 0.12, 0.1], [0.15, 0.3, 0.65], [0.2, 0.5, 0.25], [0.75, 0.75, 0.72], [0.2, 0.2, 0.22]]
)


def orbit_object(*, frames: int, edge: int, seed: int = 0) -> Cameras:
    """Return cameras of edge x edge pixels at random places on the upper hemisphere around an object.

    >>> from nerfbake import orbit_object
    >>> print(orbit_object(frames=3, edge=16))
    3 cameras
    """
    if not 1 <= frames <= 10_000:
        raise InvalidScene(Problem("frames", f"are {frames:,}", "1 to 10,000"))
    random = np.random.default_rng(seed)
    up, (across, along) = random.uniform(0.02, 0.98, frames), sine_cosine(random.uniform(0, 2 * np.pi, frames))
    flat = np.sqrt(1 - up * up)
    sine, cosine = (float(part) for part in sine_cosine(FIELD_OF_VIEW / 2))
    poses = [look_from(FOCUS, away, DISTANCE) for away in np.stack([flat * along, flat * across, up], axis=1)]
    return Cameras(
        tuple(Camera(edge, edge, 0.5 * edge * cosine / sine, pose, f"{i:04d}") for i, pose in enumerate(poses))
    )


def render_object(name: str, camera: Camera, *, samples: int = 1) -> Image:
    """Return the transparent picture of an object, struts or bricks, with samples x samples rays a pixel.

    Colours, alpha and depths are exact. The same arguments give the same bytes. Raises InvalidScene, MemoryLimit.

    >>> from nerfbake import orbit_object, render_object
    >>> image = render_object("struts", orbit_object(frames=1, edge=16).cameras[0])
    >>> image.size, image.background is None
    ((16, 16), True)
    """
    if name not in OBJECTS:
        raise InvalidScene(Problem("object", f"is {name!r}", ", ".join(OBJECTS)))
    solids, grid = _built(name)

    def traced(part: Camera) -> Image:
        part.require_memory(_RAY_BYTES)
        eye, directions = part.rays()
        out = np.empty((len(directions), 5), np.float32)
        trace_solids(solids, grid, _LAMP, np.ascontiguousarray(eye), directions, out)
        picture = out.reshape(part.height, part.width, 5)
        colour, alpha, depth = (np.ascontiguousarray(picture[..., channels]) for channels in (slice(3), 3, 4))
        return Image(colour, alpha, depth, None)

    return supersampled(traced, camera, samples)


@cache
def _built(name: str) -> tuple[Solids, SolidGrid]:
    solids = _struts() if name == "struts" else _bricks()
    return solids, grid_of(solids)


def _boxes(low: Points, high: Points, colour: Floats, gloss: float) -> Floats:
    """Return rows for _solids(): boxes between these corners (n, 3), of one colour (3,) or of one each (n, 3)."""
    return _rods(low, high, 0.0, colour, gloss)


def _rods(first: Points, second: Points, radius: float, colour: Floats, gloss: float) -> Floats:
    """Return rows (n, 11) for _solids(): rods between these ends (n, 3)."""
    ends = np.broadcast_arrays(np.atleast_2d(first), np.atleast_2d(second), np.atleast_2d(colour))
    return np.column_stack([*ends, np.full((len(ends[0]), 2), (radius, gloss))])


def _solids(rows: list[Floats]) -> Solids:
    parts = np.split(np.concatenate(rows), [3, 6, 9, 10], axis=1)
    first, second, colour, radius, gloss = (np.ascontiguousarray(part) for part in parts)
    return Solids(first, second, radius[:, 0].copy(), colour, gloss[:, 0].copy())


def _girder(start: Points, end: Points, side: Points, bays: int, colour: Floats) -> list[Floats]:
    """Return a girder of four long rods, with a ring and four diagonals in each bay. side: to its first edge."""
    axis = (end - start) / np.sqrt(((end - start) ** 2).sum())
    across = np.cross(axis, side)
    places = start + np.linspace(0, 1, bays + 1)[:, None, None] * (end - start)
    corners = places + np.stack([side, across, -side, -across])
    following = np.roll(corners, 1, axis=1)
    return [
        _rods(corners[0], corners[-1], 0.01, colour, 0.3),
        _rods(corners.reshape(-1, 3), following.reshape(-1, 3), 0.006, colour, 0.3),
        _rods(corners[:-1].reshape(-1, 3), following[1:].reshape(-1, 3), 0.004, colour, 0.3),
    ]


def _struts() -> Solids:
    random, steel = np.random.default_rng(1), np.array([0.45, 0.46, 0.5])
    up, foot, top = np.array([0, 0, 1.0]), np.array([-0.5, 0.5, 0.04]), np.array([-0.5, 0.5, 1.2])
    tip, crook = np.array([0.75, -0.75, 1.2]), np.array([-0.5, 0.5, 1.5])
    rows = [_boxes(np.array([-0.9, -0.9, 0]), np.array([0.9, 0.9, 0.04]), np.array([0.3, 0.32, 0.3]), 0.4)]
    rows += _girder(foot, crook, np.array([0.09, 0, 0]), 18, _PALETTE[0])
    rows += _girder(top - 0.2 * (tip - top), tip, 0.08 * up, 22, _PALETTE[1])
    # Cables from the top of the mast to the boom, and from the boom to the ground.
    held = top + np.linspace(-0.2, 1, 13)[:, None] * (tip - top)
    rows += [_rods(crook, held + 0.08 * up, 0.004, steel, 0.3), _rods(held, held * [1, 1, 0], 0.004, steel, 0.3)]
    # A wheel with spokes from both ends of its hub.
    hub, axle = np.array([-0.45, -0.45, 0.44]), np.array([0.06, 0, 0])
    sine, cosine = sine_cosine(np.arange(48) * (2 * np.pi / 48))
    rim = hub + 0.38 * np.stack([0 * sine, cosine, sine], axis=1)
    rows += [
        _rods(rim, np.roll(rim, 1, axis=0), 0.012, np.array([0.1, 0.1, 0.1]), 0.1),
        _rods(hub + axle, rim[::2], 0.004, steel, 0.5),
        _rods(hub - axle, rim[1::2], 0.004, steel, 0.5),
        _rods(hub - axle, hub + axle, 0.03, _PALETTE[1], 0.5),
    ]
    # A cage of wires around boxes, seen through it.
    low, wide, tall = np.array([0.1, 0.1, 0.04]), 0.66, 0.56
    along = np.linspace(0, wide, 23)[:, None]
    for x, y in (np.array([1.0, 0, 0]), np.array([0, 1.0, 0])), (np.array([0, 1.0, 0]), np.array([1.0, 0, 0])):
        for far in (0.0, wide):
            foot = low + along * x + far * y
            rows.append(_rods(foot, foot + tall * up, 0.004, steel, 0.3))
            level = low + far * y + np.linspace(0, tall, 15)[:, None] * up
            rows.append(_rods(level, level + wide * x, 0.004, steel, 0.3))
        rows.append(_rods(low + along * x + tall * up, low + along * x + tall * up + wide * y, 0.004, steel, 0.3))
    size, corner = random.uniform(0.04, 0.16, (60, 3)), random.uniform(0, 1, (60, 3))
    corner = low + 0.02 + corner * (np.array([wide, wide, 0.7 * tall]) - 0.04 - size)
    rows.append(_boxes(corner, corner + size, _PALETTE[random.integers(0, 6, 60)], 0.3))
    return _solids(rows)


def _bricks() -> Solids:
    random, pitch, tall, N, layers = np.random.default_rng(2), 0.04, 0.048, 48, 24
    high = np.array([0, 0, 0.01])  # of a stud
    held = np.zeros((N, N, layers + 1), bool)
    held[8:40, 8:40, :16] = True  # a house,
    held[10:38, 10:38, :16] = False
    held[10:26, 22:24, :12] = held[24:26, 24:38, :9] = True  # with walls inside,
    for side in (slice(8, 10), slice(38, 40)):
        for window in range(12, 36, 8):
            held[side, window : window + 4, 5:11] = held[window : window + 4, side, 5:11] = False
    held[8:10, 28:32, :11] = False  # a door,
    held[8:40, 10:38:4, 16] = held[10:38:7, 8:40, 17] = True  # a roof of beams,
    held[12:16, 12:16, :24] = True  # and a tower through it
    for _ in range(60):  # things inside and outside
        left, front, height = random.integers(0, N - 6), random.integers(0, N - 6), random.integers(1, 8)
        held[left : left + random.integers(1, 6), front : front + random.integers(1, 6), :height] = True
    x, y, z = np.nonzero(held)
    stud, green = np.array([pitch / 2, pitch / 2, 0.0]), np.array([0.3, 0.45, 0.3])
    corner = np.stack([x - N / 2, y - N / 2, z], axis=1) * [pitch, pitch, tall] + np.array([0, 0, 0.02])
    paint, turn = random.integers(0, 6, (N, N, layers)), z % 2  # bricks of 2x4 studs, in turn along x and along y
    colour = _PALETTE[paint[x // (2 + 2 * turn), y // (4 - 2 * turn), z]]
    edge = N / 2 * pitch
    rows = [
        _boxes(np.array([-edge, -edge, 0]), np.array([edge, edge, 0.02]), green, 0.5),
        _boxes(corner, corner + np.array([pitch, pitch, tall]), colour, 0.35),
    ]
    bare = ~held[x, y, z + 1]
    foot = corner[bare] + stud + np.array([0, 0, tall])
    rows.append(_rods(foot, foot + high, 0.012, colour[bare], 0.35))
    x, y = np.nonzero(~held[:, :, 0] & (np.arange(N) < 38))  # the rest of the ground is a glossy plate without studs
    foot = np.column_stack([(x - N / 2) * pitch, (y - N / 2) * pitch, np.full(len(x), 0.02)]) + stud
    rows.append(_rods(foot, foot + high, 0.012, green, 0.2))
    return _solids(rows)
