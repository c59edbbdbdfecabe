"""Checkpoints of SVRaster by seed, as its code lays them out, and their densities in float64."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np

from nerfbake.formats.wire.torch_writer import torch_file

LEVELS = 16


@dataclass(frozen=True)
class Voxels:
    """Voxels in any order.

    levels, cells  (n,) and (n, 3): a voxel of level l is a cell of a grid of 2^l
    corners        (m, 3) the distinct corners, in cells of level 16, sorted
    raw            (m,) raw densities of the corners
    sh             (n, 16, 3)
    """

    levels: np.ndarray
    cells: np.ndarray
    corners: np.ndarray
    raw: np.ndarray
    sh: np.ndarray
    centre: np.ndarray
    extent: float
    inside: float
    degree: int

    @property
    def edges(self) -> np.ndarray:
        return self.extent / 2.0**self.levels

    @property
    def middles(self) -> np.ndarray:
        """(n, 3) centres in the world."""
        return np.asarray(self.centre - self.extent / 2 + (self.cells + 0.5) * self.edges[:, None])


def voxels(seed: int = 0, *, depth: int = 4, outside: int = 0, degree: int = 1) -> Voxels:
    """Leaves of a random tree, without some of them. outside: levels of the scene around the inner cube."""
    random = np.random.default_rng(seed)
    found: list[tuple[int, tuple[int, ...]]] = []
    waiting = [(1, cell) for cell in product(range(2), repeat=3)]
    while waiting:
        level, cell = waiting.pop()
        if level < depth and random.random() < 0.4:
            waiting += [(level + 1, tuple(2 * a + b for a, b in zip(cell, each, strict=True)))
                        for each in product(range(2), repeat=3)]  # fmt: skip
        elif random.random() < 0.8:
            found.append((level, cell))
    random.shuffle(found)
    levels, cells = np.array([level for level, _ in found]), np.array([cell for _, cell in found])
    scale = 1 << (LEVELS - levels)
    every = (cells[:, None] + np.array([*product((0, 1), repeat=3)])) * scale[:, None, None]
    corners = np.unique(every.reshape(-1, 3), axis=0)
    return Voxels(
        levels,
        cells,
        corners,
        random.normal(0, 2, len(corners)).astype(np.float32),
        random.normal(0, 0.3, (len(found), 16, 3)).astype(np.float32),
        np.array([0.5, -1, 2]),
        4.0 * 2**outside,
        4.0,
        degree,
    )


def svraster(scene: Voxels, *, quantised: bool = False) -> dict[str, Any]:
    """What torch.save() gets."""
    paths = np.zeros(len(scene.levels), np.int64)
    for voxel, (level, cell) in enumerate(zip(scene.levels, scene.cells, strict=True)):
        for step in range(1, level + 1):
            x, y, z = (int(part) >> (level - step) & 1 for part in cell)
            paths[voxel] |= (x << 2 | y << 1 | z) << 3 * (LEVELS - step)
    found: dict[str, Any] = {
        "active_sh_degree": scene.degree,
        "scene_center": scene.centre.astype(np.float32),
        "scene_extent": np.array([scene.extent], np.float32),
        "inside_extent": np.array([scene.inside], np.float32),
        "octpath": paths[:, None],
        "octlevel": scene.levels.astype(np.int8)[:, None],
        "_geo_grid_pts": scene.raw[:, None],
        "_sh0": scene.sh[:, 0],
        "_shs": scene.sh[:, 1:],
        "quantized": quantised,
    }
    if quantised:
        found["_geo_grid_pts"] = coded(scene.raw[:, None])
        found["_sh0"] = [coded(scene.sh[:, 0, k, None]) for k in range(3)]
        found["_shs"] = [coded(scene.sh[:, k, None]) for k in range(1, 16)]
    return found


def svraster_file(scene: Voxels | None = None, *, quantised: bool = False, **changes: Any) -> bytes:
    return torch_file(svraster(voxels() if scene is None else scene, quantised=quantised) | changes)


def coded(values: np.ndarray) -> dict[str, np.ndarray]:
    """Bytes with a codebook of evenly spaced values."""
    low, high = float(values.min()), float(values.max())
    codes = np.rint((values - low) / (high - low) * 255).astype(np.uint8)
    return {"index": codes, "codebook": np.linspace(low, high, 256).astype(np.float32)}


def density_at(scene: Voxels, voxel: int, place: np.ndarray) -> float:
    """1/world unit at a place in a voxel, 0 to 1 along each axis: interpolated, then activated."""
    rows = {tuple(corner): row for row, corner in enumerate(scene.corners.tolist())}
    scale, total = 1 << (LEVELS - int(scene.levels[voxel])), 0.0
    for corner in product((0, 1), repeat=3):
        share = np.prod([p if bit else 1 - p for p, bit in zip(place, corner, strict=True)])
        at = tuple(int(scale * (cell + bit)) for cell, bit in zip(scene.cells[voxel], corner, strict=True))
        total += share * float(scene.raw[rows[at]])
    return 100 * (total if total > 1.1 else float(np.exp(0.909090909 * total - 0.904689820)))


def mean_density(scene: Voxels, voxel: int) -> float:
    places = [np.array(each) for each in product((0.25, 0.75), repeat=3)]
    return float(np.mean([density_at(scene, voxel, place) for place in places]))
