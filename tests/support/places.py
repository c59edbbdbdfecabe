"""Test points for lookups, (n, 4) float32: x, y, z in voxels, and the index of a value."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from tests.support.shaders import Points

COUNT = 120_000


def in_grid(size: tuple[int, ...], channels: int) -> Points:
    """Points in and around a grid from 0 to size, on voxel faces, at the next float beside them, and very far away."""
    random = np.random.default_rng(1)
    points = _numbered(channels)
    points[:, :3] = random.uniform(-3, np.array(size) + 3, (COUNT, 3))
    _onto_halves(points[: COUNT // 3, :3])
    points[:7, :3] = [
        [1e30, 0, 0],
        [-1e30, 1, 1],
        [0, 3e9, 0],
        [0, -5e9, 0],
        [0, 0, np.inf],
        [-np.inf, 0, 0],
        [0.0, 0.0, 0.0],
    ]
    points[7, :3] = size
    return points


def around(coords: npt.NDArray[Any], channels: int) -> Points:
    """Points near voxels, on their faces, at the next float beside them, in missing tiles, and very far away."""
    random = np.random.default_rng(1)
    points = _numbered(channels)
    points[:, :3] = random.choice(coords, COUNT) + random.uniform(-2, 2, (COUNT, 3))
    points[COUNT // 2 : COUNT * 2 // 3, :3] *= 3
    _onto_halves(points[: COUNT // 3, :3])
    points[:4, :3] = [[1e30, 0, 0], [0, -3e9, 0], [0, 0, np.inf], [-0.0, -0.5, 0.5]]
    return points


def clouds() -> npt.NDArray[np.int64]:
    """(m, 3) clouds of voxels around corners of root tiles of a VDB, with positive and negative coordinates."""
    random = np.random.default_rng(0)
    middles = np.array([[0, 0, 0], [4096, -4096, 0], [-8192, 4100, 130], [9000, 9000, -9000]])
    cloud = np.concatenate([middle + random.normal(0, 6, (1500, 3)) for middle in middles])
    return np.unique(np.floor(cloud).astype(np.int64), axis=0)


def _numbered(channels: int) -> Points:
    points = np.zeros((COUNT, 4), np.float32)
    points[:, 3] = np.arange(COUNT) % channels
    return points


def _onto_halves(points: npt.NDArray[np.float32]) -> None:
    """Move points to multiples of 1/2, in place, and two thirds of them to the next float below or above.

    These are the voxel faces, whether voxel centres are at integers or at halves.
    """
    points[:] = np.round(2 * points) / 2
    points[::3] = np.nextafter(points[::3], np.float32(np.inf))
    points[1::3] = np.nextafter(points[1::3], np.float32(-np.inf))
    points[abs(points) < 1e-30] *= 1e30  # processors may flush denormals to 0
