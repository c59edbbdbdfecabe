"""Splats of things as captures have them, upright (-y up): with and without the ground, in rooms, and hanging."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import Any

import numpy as np

from nerfbake import Splats

Parts = list[np.ndarray]
_PER_AREA = 400  # centres


class _Maker:
    """Points on surfaces, y up."""

    def __init__(self, seed: int) -> None:
        self.random = np.random.default_rng(seed)
        self.parts: Parts = []

    def plane(self, centre: Any, u: Any, v: Any, share: float = 1) -> None:
        """A parallelogram of half edges u and v."""
        u, v = np.asarray(u, float), np.asarray(v, float)
        n = int(share * _PER_AREA * 4 * np.linalg.norm(np.cross(u, v))) + 60
        a = self.random.uniform(-1, 1, (n, 2))
        self.parts.append(centre + a[:, :1] * u + a[:, 1:] * v)

    def box(self, centre: Any, x: float, y: float, z: float) -> None:
        middle = np.asarray(centre, float)
        edges = np.diag([x, y, z])
        for k in range(3):
            for sign in (-1, 1):
                self.plane(middle + sign * edges[k], edges[k - 1], edges[k - 2])

    def turned(self, *profile: tuple[float, float], x: float = 0, z: float = 0) -> None:
        """A surface of revolution through (radius, height)."""
        for (r, h), (s, i) in pairwise(profile):
            n = int(_PER_AREA * np.pi * (r + s) * np.hypot(r - s, h - i)) + 40
            share, angle = self.random.uniform(0, 1, n), self.random.uniform(0, 2 * np.pi, n)
            radius = r + (s - r) * share
            self.parts.append(
                np.stack([x + radius * np.cos(angle), h + (i - h) * share, z + radius * np.sin(angle)], 1)
            )

    def ball(self, centre: Any, x: float, y: float, z: float) -> None:
        n = int(_PER_AREA * 4 * np.pi * ((x + y + z) / 3) ** 2) + 40
        way = self.random.normal(size=(n, 3))
        way /= np.linalg.norm(way, axis=1, keepdims=True)
        self.parts.append(centre + way * [x, y, z])

    def splats(self, tilt: float) -> Splats:
        """Turned about y, tilted by degrees, with noise and floaters."""
        points = np.concatenate(self.parts)
        points = points[self.random.permutation(len(points))[:4000]]
        size = np.ptp(points, axis=0).max()
        points = points + 0.004 * size * self.random.normal(size=points.shape)
        low, high = points.min(axis=0) - 0.2 * size, points.max(axis=0) + 0.2 * size
        points = np.concatenate([points, self.random.uniform(low, high, (len(points) // 100, 3))])
        around, lean = self.random.uniform(0, 2 * np.pi), np.radians(tilt)
        spin = np.array([[np.cos(around), 0, np.sin(around)], [0, 1, 0], [-np.sin(around), 0, np.cos(around)]])
        lying = np.array([[1, 0, 0], [0, np.cos(lean), -np.sin(lean)], [0, np.sin(lean), np.cos(lean)]])
        n = len(points)
        means = points @ (lying @ spin).T * [1, -1, -1]
        turn = np.tile(np.array([1, 0, 0, 0], np.float32), (n, 1))
        sizes = np.full((n, 3), 0.01 * size, np.float32)
        return Splats(
            means.astype(np.float32), sizes, turn, np.full(n, 0.8, np.float32), np.zeros((n, 1, 3), np.float32)
        )


def _legs(m: _Maker, x: float, height: float, z: float) -> None:
    for a in (-x, x):
        for b in (-z, z):
            m.box((a, height / 2, b), 0.03, height / 2, 0.03)


def _tree(m: _Maker) -> None:
    m.turned((0.06, 0), (0.05, 1))
    m.ball((0, 1.5, 0), 0.6, 0.6, 0.6)


def _table(m: _Maker) -> None:
    m.plane((0, 0.75, 0), (0.8, 0, 0), (0, 0, 0.5))
    _legs(m, 0.75, 0.75, 0.45)


def _walls(m: _Maker, height: float) -> None:
    m.plane((0, 0, 0), (2, 0, 0), (0, 0, 1.5))
    for sign in (-1, 1):
        m.plane((2 * sign, height / 2, 0), (0, height / 2, 0), (0, 0, 1.5))
        m.plane((0, height / 2, 1.5 * sign), (2, 0, 0), (0, height / 2, 0))
    m.box((0.5, 0.4, 0.3), 0.6, 0.4, 0.4)


def _ground(m: _Maker, radius: float) -> None:
    m.turned((0, 0), (radius, 0))


def _many(*parts: Callable[[_Maker], object]) -> Callable[[_Maker], None]:
    def make(m: _Maker) -> None:
        for part in parts:
            part(m)

    return make


STANDING: dict[str, Callable[[_Maker], object]] = {
    "a tree on the ground": _many(_tree, lambda m: _ground(m, 1.5)),
    "a table on the floor": _many(_table, lambda m: _ground(m, 1.6), lambda m: m.ball((0.2, 0.9, 0), 0.12, 0.12, 0.12)),
    "a house": _many(
        lambda m: m.box((0, 0.6, 0), 1, 0.6, 0.7),
        lambda m: m.plane((0, 1.5, 0.35), (1.1, 0, 0), (0, -0.3, 0.4)),
        lambda m: m.plane((0, 1.5, -0.35), (1.1, 0, 0), (0, 0.3, 0.4)),
        lambda m: m.plane((0, 0, 0), (3, 0, 0), (0, 0, 3), 0.4),
    ),
    "a car": _many(
        lambda m: m.box((0, 0.55, 0), 2, 0.35, 0.8),
        lambda m: m.box((-0.2, 1.1, 0), 1, 0.3, 0.7),
        lambda m: _ground(m, 4),
    ),
    "a statue on a pedestal": _many(
        lambda m: m.box((0, 0.3, 0), 0.4, 0.3, 0.4), lambda m: m.ball((0, 1.2, 0), 0.25, 0.6, 0.2)
    ),
    "a turntable": _many(lambda m: _ground(m, 0.5), lambda m: m.ball((0, 0.3, 0), 0.25, 0.3, 0.2)),
    "a parasol": _many(
        lambda m: m.turned((0.02, 0), (0.02, 2)),
        lambda m: m.turned((1.3, 1.7), (0.7, 2.0), (0, 2.1)),
        lambda m: _ground(m, 2),
    ),
    "a chair": _many(
        lambda m: m.plane((0, 0.45, 0), (0.25, 0, 0), (0, 0, 0.25), 4),
        lambda m: m.plane((0, 0.8, -0.24), (0.25, 0, 0), (0, 0.35, 0), 4),
        lambda m: _legs(m, 0.23, 0.45, 0.23),
    ),
    "a vase": lambda m: m.turned((0, 0), (0.25, 0), (0.3, 0.2), (0.15, 0.7), (0.35, 1)),
    "a tree": _tree,
    "a goblet": lambda m: m.turned((0, 0), (0.3, 0), (0.04, 0.05), (0.04, 0.6), (0.35, 0.8), (0.33, 1.2)),
    "a table": _table,
    "a lamp": lambda m: m.turned((0, 0), (0.25, 0), (0.02, 0.01), (0.02, 1.2), (0.35, 1.2), (0.2, 1.6)),
    "a room": _many(lambda m: _walls(m, 2.4), lambda m: m.plane((0, 2.4, 0), (2, 0, 0), (0, 0, 1.5))),
    "a room without a ceiling": lambda m: _walls(m, 2.4),
    "a street": _many(
        lambda m: m.plane((0, 0, 0), (2, 0, 0), (0, 0, 8), 0.3),
        lambda m: m.plane((-2, 3, 0), (0, 3, 0), (0, 0, 8), 0.3),
        lambda m: m.plane((2, 3, 0), (0, 3, 0), (0, 0, 8), 0.3),
    ),
    "a person": _many(
        lambda m: m.ball((0, 1.65, 0), 0.1, 0.13, 0.11),
        lambda m: m.ball((0, 1.2, 0), 0.22, 0.35, 0.15),
        lambda m: m.turned((0.09, 0), (0.1, 0.85), x=-0.12),
        lambda m: m.turned((0.09, 0), (0.1, 0.85), x=0.12, z=0.1),
    ),
    "a ball": lambda m: m.ball((0, 0, 0), 1, 1, 1),
    "a mug": _many(
        lambda m: m.turned((0, 0), (0.35, 0), (0.35, 0.9)), lambda m: m.turned((0.04, 0.2), (0.06, 0.7), x=0.45)
    ),
    "a mushroom": lambda m: m.turned((0.15, 0), (0.12, 0.6), (0.6, 0.55), (0.55, 0.75), (0.3, 0.95), (0, 1)),
    "a bridge": _many(
        lambda m: m.plane((0, 2, 0), (6, 0, 0), (0, 0, 1)),
        lambda m: m.box((-4, 1, 0), 0.3, 1, 0.8),
        lambda m: m.box((0, 1, 0), 0.3, 1, 0.8),
        lambda m: m.box((4, 1, 0), 0.3, 1, 0.8),
    ),
    # The rule is wrong about these if they stand straight.
    "a bowl": lambda m: m.turned((0, 0), (0.15, 0), (0.5, 0.2), (0.7, 0.5)),
    "a bar table": _many(
        lambda m: m.turned((0.05, 0), (0.05, 1.2)), lambda m: m.plane((0, 1.2, 0), (0.7, 0, 0), (0, 0, 0.7))
    ),
    "a thing below a ceiling": _many(
        lambda m: m.plane((0, 2.5, 0), (2, 0, 0), (0, 0, 2)), lambda m: m.box((0, 1.5, 0), 0.4, 1, 0.4)
    ),
}


def standing(name: str, *, seed: int = 0, tilt: float = 0) -> Splats:
    maker = _Maker(seed)
    STANDING[name](maker)
    return maker.splats(tilt)
