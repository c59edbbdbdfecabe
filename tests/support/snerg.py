"""Synthetic SNeRG folders: random blocks in a sliced atlas, with reference values at any point."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
from PIL import Image

from nerfbake.formats.wire.picture import png_of

Files = dict[str, bytes]
BLOCK, GRID = 3, (8, 6, 11)
BLOCKS = (3, 2, 4)
ATLAS_BLOCKS = (3, 2, 2)  # of 5^3 voxels; the atlas is a little larger
ATLAS = (17, 10, 12)
VOXEL, LOW = 0.25, (-1.0, 0.5, -2.0)
TURN = [[-1, 0, 0, 0.25], [0, 0, 1, -0.5], [0, 1, 0, 1], [0, 0, 0, 1]]
HELD = [(0, 0, 0), (1, 0, 0), (2, 1, 0), (1, 1, 1), (0, 1, 3), (2, 0, 3), (1, 0, 2)]
PLACES = [(2, 1, 1), (0, 0, 0), (1, 1, 0), (2, 0, 1), (0, 1, 1), (1, 0, 0), (0, 1, 0)]


def snerg(*, seed: int = 3, alpha: int | None = None, diffuse: bool = False) -> dict[str, Any]:
    """Return the contents of a SNeRG folder.

    fields   scene_params.json
    indices  (X, Y, Z, 3)
    atlas    (W, H, D, 8) red, green, blue, features and opacity

    alpha: the opacity of all voxels, with the other channels at half of it; None: random opacities, about 30 % of them
    0.
    """
    random = np.random.default_rng(seed)
    size = tuple(b * BLOCK + 2 for b in BLOCKS)
    opacity = random.integers(1, 256, size) * (random.random(size) > 0.3)
    whole = np.concatenate([random.random((*size, 7)) * opacity[..., None], opacity[..., None]], axis=3)
    if alpha is not None:
        whole[..., :7], whole[..., 7] = alpha // 2, alpha
    indices = np.full((*BLOCKS, 3), 255, np.uint8)
    atlas = np.zeros((*ATLAS, 8), np.uint8)
    for block, place in zip(HELD, PLACES, strict=True):
        indices[block] = place
        there = tuple(slice(i * (BLOCK + 2), (i + 1) * (BLOCK + 2)) for i in place)
        atlas[there] = whole[tuple(slice(i * BLOCK, i * BLOCK + BLOCK + 2) for i in block)]
    names = ("width", "height", "depth")
    fields: dict[str, Any] = {
        "voxel_size": VOXEL,
        "block_size": BLOCK,
        **{f"grid_{name}": edge for name, edge in zip(names, GRID, strict=True)},
        **{f"atlas_{name}": edge for name, edge in zip(names, ATLAS, strict=True)},
        **{f"atlas_blocks_{axis}": edge for axis, edge in zip("xyz", ATLAS_BLOCKS, strict=True)},
        **{f"min_{axis}": low for axis, low in zip("xyz", LOW, strict=True)},
        "num_slices": ATLAS[2] // 4,
        "input_height": 800.0,
        "worldspace_T_opengl": TURN,
        "ndc": False,
        "format": "png",
        **({"diffuse": True} if diffuse else {}),
    }
    for layer, (inputs, outputs) in enumerate(((34, 8), (8, 8), (8, 3))):
        fields[f"{layer}_weights"] = random.normal(0, 0.4, (inputs, outputs)).tolist()
        fields[f"{layer}_bias"] = random.normal(0, 0.4, outputs).tolist()
    return {"fields": fields, "indices": indices, "atlas": atlas}


def snerg_folder(made: dict[str, Any]) -> Files:
    """The files of a folder, as SNeRG exports them."""
    indices, atlas, fields = made["indices"], made["atlas"], made["fields"]
    flat = indices.transpose(2, 1, 0, 3).reshape(-1, indices.shape[0], 3)
    files = {"scene_params.json": json.dumps(fields).encode(), "atlas_indices.png": png(flat)}
    for number in range(atlas.shape[2] // 4):
        slices = [atlas[:, :, 4 * number + i].transpose(1, 0, 2) for i in range(4)]
        stacked = np.concatenate(slices, axis=0)
        files[f"rgba_{number:03d}.png"] = png(stacked[..., [0, 1, 2, 7]])
        if not fields.get("diffuse"):
            files[f"feature_{number:03d}.png"] = png(stacked[..., 3:7])
    return files


def png(pixels: Any) -> bytes:
    return png_of(Image.fromarray(np.ascontiguousarray(pixels)))


# -- reference values -----------------------------------------------------------------------------------------
def values_at(made: dict[str, Any], points: Any) -> Any:
    """(m, 8) values from 0 to 1 at world points (m, 3), as SNeRG's renderer interpolates them; 0 in empty blocks."""
    turn = np.array(made["fields"]["worldspace_T_opengl"], float)
    inner = np.linalg.solve(turn[:3, :3], (points - turn[:3, 3]).T).T
    at = (inner - np.array([made["fields"][f"min_{axis}"] for axis in "xyz"])) / VOXEL
    out = np.zeros((len(points), 8))
    for i, place in enumerate(at):
        block = np.floor(place / BLOCK).astype(int)
        if (block < 0).any() or (block >= BLOCKS).any() or made["indices"][tuple(block)][0] == 255:
            continue
        where = place - block * BLOCK + made["indices"][tuple(block)].astype(int) * (BLOCK + 2) + 1 - 0.5
        low = np.floor(where).astype(int)
        for step in np.ndindex(2, 2, 2):
            weight = np.prod(1 - np.abs(low + step - where))
            out[i] += weight * made["atlas"][tuple(low + step)] / 255
    return out


def added(made: dict[str, Any], values: Any, directions: Any) -> Any:
    """(m, 3) the specular colour that the MLP returns for values (m, 7) and world directions (m, 3)."""
    fields = made["fields"]
    angles = np.concatenate([directions * scale for scale in (1, 2, 4, 8)], axis=1)
    x = np.concatenate([directions, np.sin(angles), np.cos(angles), values], axis=1)
    for layer in range(3):
        x = x @ np.array(fields[f"{layer}_weights"]) + fields[f"{layer}_bias"]
        x = np.maximum(x, 0) if layer < 2 else x
    return 1 / (1 + np.exp(-x))


def density_of(values: Any) -> Any:
    """(m,) the density per world unit."""
    return -np.log(np.maximum(1 - values[:, 7], 1 / 510)) / VOXEL


def colour_at(made: dict[str, Any], points: Any, direction: Any) -> Any:
    """(m, 3) the colour at points with density."""
    values = values_at(made, points)
    bare = values[:, :7] / values[:, 7:]
    more = added(made, bare, np.broadcast_to(direction, (len(points), 3)))
    return np.minimum(bare[:, :3] + (0 if made["fields"].get("diffuse") else more), 1)
