"""Synthetic MERF folders: random blocks in a sliced atlas and three planes, with reference values at any point."""

from __future__ import annotations

import json
from typing import Any

import numpy as np

from tests.support.snerg import Files, png

BLOCK, GRID, PLANES = 3, 21, 27  # 7 blocks per axis, 5 of them in the inner cube; all sizes are odd
BLOCKS = 7
ATLAS_BLOCKS = (4, 3, 2)  # of 4^3 nodes; the atlas is a little larger
ATLAS = (17, 14, 9)
DENSITY, FEATURES = (-2.0, 3.0), (-4.0, 5.0)
SKIPPED = 0.5 / 255  # opacity over a step of one plane cell, below which the viewer skips a sample
OUTSIDE = [(0, 3, 3), (6, 6, 6)]


def merf(*, seed: int = 5, planes: bool = True, mlp: bool = True) -> dict[str, Any]:
    """Return the contents of a MERF folder, with random bytes.

    fields   scene_params.json
    indices  (X, Y, Z, 3)
    atlas    (W, H, D, 8) red, green, blue, density and features; faces of adjacent blocks differ
    planes   three of (R, R, 8), each over two axes of the grid

    mlp: False sets all weights to 0, so that the MLP adds the same to every colour.
    """
    random = np.random.default_rng(seed)
    indices = np.full((BLOCKS,) * 3 + (3,), 255, np.uint8)
    inner = random.permutation(np.argwhere(np.ones((5,) * 3)))[:22] + 1
    places = random.permutation(np.argwhere(np.ones(ATLAS_BLOCKS)))
    for block, place in zip([*OUTSIDE, *inner], places, strict=True):
        indices[tuple(block)] = place
    fields: dict[str, Any] = {
        "triplane_resolution": PLANES if planes else -1,
        "triplane_voxel_size": 4 / PLANES if planes else -4.0,
        "sparse_grid_resolution": GRID,
        "sparse_grid_voxel_size": 4 / GRID,
        "range_features": list(FEATURES),
        "range_density": list(DENSITY),
        "data_block_size": BLOCK,
        **{f"atlas_{name}": edge for name, edge in zip(("width", "height", "depth"), ATLAS, strict=True)},
        "num_slices": ATLAS[2],
        "slice_depth": 1,
    }
    for layer, (inputs, outputs) in enumerate(((34, 8), (8, 8), (8, 3))):
        scale = 0.4 if mlp else 0.0
        fields[f"{layer}_weights"] = random.normal(0, scale, (inputs, outputs)).tolist()
        fields[f"{layer}_bias"] = random.normal(0, 0.4, outputs).tolist()
    made = {"fields": fields, "indices": indices, "atlas": random.integers(0, 256, (*ATLAS, 8), np.uint8)}
    return made | {"planes": [random.integers(0, 256, (PLANES, PLANES, 8), np.uint8) for _ in range(3 * planes)]}


def merf_folder(made: dict[str, Any]) -> Files:
    """The files of a folder, as MERF exports them."""
    indices, atlas = made["indices"], made["atlas"]
    files = {"scene_params.json": json.dumps(made["fields"]).encode()}
    flat = indices.transpose(2, 1, 0, 3).reshape(-1, indices.shape[0], 3)
    files["sparse_grid_block_indices.png"] = png(flat)
    for z in range(atlas.shape[2]):
        files |= _pair("sparse_grid_rgb_and_density", "sparse_grid_features", f"{z:03d}", atlas[:, :, z])
    for number, plane in enumerate(made["planes"]):
        files |= _pair("plane_rgb_and_density", "plane_features", str(number), plane)
    return files


def _pair(first: str, second: str, number: str, values: Any) -> Files:
    rows = values.transpose(1, 0, 2)
    return {f"{first}_{number}.png": png(rows[..., :4]), f"{second}_{number}.png": png(rows[..., 4:])}


# -- reference values -----------------------------------------------------------------------------------------
def in_grid(points: Any, resolution: int) -> Any:
    """Convert points (m, 3) of the inner cube to node coordinates of a grid."""
    v = 4 / resolution
    x, y, z = np.asarray(points, float).T
    return np.stack([(2 - v / 2 - x) / v, (z + 2 - v / 2) / v, (y + 2 - v / 2) / v], axis=1)


def sums_at(made: dict[str, Any], points: Any) -> tuple[Any, Any]:
    """(m,) whether a block exists at each point, and (m, 8) the sums of the interpolated values."""
    held, out = np.zeros(len(points), bool), np.zeros((len(points), 8))
    in_planes = in_grid(points, PLANES)
    for i, at in enumerate(in_grid(points, GRID)):
        block = np.floor(at / BLOCK).astype(int)
        if np.abs(points[i]).max() > 1 or made["indices"][tuple(block)][0] == 255:
            continue
        held[i] = True
        place = at - block * BLOCK + made["indices"][tuple(block)].astype(int) * (BLOCK + 1)
        out[i] = _meant(_linear(made["atlas"], place))
        for number, plane in enumerate(made["planes"]):
            out[i] += _meant(_linear(plane, np.delete(in_planes[i], number)))
    return held, out


def _linear(values: Any, at: Any) -> Any:
    low, total = np.floor(at).astype(int), 0.0
    for step in np.ndindex(*(2,) * len(at)):
        weight = np.prod(1 - np.abs(low + step - at))
        total = total + (weight * values[tuple(low + step)] if weight else 0.0)
    return total


def _meant(q: Any) -> Any:
    """Convert bytes to values."""
    out = FEATURES[0] + (FEATURES[1] - FEATURES[0]) * q / 255
    out[3] = DENSITY[0] + (DENSITY[1] - DENSITY[0]) * q[3] / 255
    return out


def density_of(made: dict[str, Any], held: Any, sums: Any) -> Any:
    """(m,) the density per world unit."""
    v = 4 / (PLANES if made["planes"] else GRID)
    density = np.where(held, np.exp(sums[:, 3] - 1), 0)
    return np.where(1 - np.exp(-density * v) > SKIPPED, density, 0)


def values_of(sums: Any) -> Any:
    """(m, 7) the diffuse colour and four features."""
    return 1 / (1 + np.exp(-np.delete(sums, 3, axis=1)))


def added(made: dict[str, Any], values: Any, directions: Any) -> Any:
    """(m, 3) the specular colour that the MLP returns for values (m, 7) and directions (m, 3)."""
    fields = made["fields"]
    angles = np.concatenate([directions * scale for scale in (1, 2, 4, 8)], axis=1)
    x = np.concatenate([values, directions, np.sin(angles), np.cos(angles)], axis=1)
    for layer in range(3):
        x = x @ np.array(fields[f"{layer}_weights"]) + fields[f"{layer}_bias"]
        x = np.maximum(x, 0) if layer < 2 else x
    return 1 / (1 + np.exp(-x))


def colour_at(made: dict[str, Any], sums: Any, direction: Any) -> Any:
    """(m, 3) the colour at points with density."""
    values = values_of(sums)
    return np.minimum(values[:, :3] + added(made, values, np.broadcast_to(direction, (len(sums), 3))), 1)
