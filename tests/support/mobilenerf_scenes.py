"""A complete MobileNeRF folder of three quads, made by hand, and its pictures in plain NumPy."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from nerfbake.formats.wire.picture import encode_texture
from nerfbake.kernels.arrays import Floats
from nerfbake.scene.camera import Camera

PATCH, EDGE = 17, 64  # texels of a quad and of the texture along an edge
# Corner, and the two edges along u and v, in the NeRF's world: z is up. The second quad hides part of the first, and
# the third stands across both.
QUADS = np.array(
    [
        [[-1, -1, 0], [2, 0, 0], [0, 2, 0]],
        [[-0.6, -0.9, 0.4], [1.3, 0, 0.1], [0, 1.1, 0]],
        [[0.1, -1, -0.2], [0, 1.7, 0], [0.1, 0, 1]],
    ],
    np.float64,
)


def layers(hidden: int = 16, seed: int = 0) -> dict[str, npt.NDArray[np.float32]]:
    random = np.random.default_rng(seed)
    sizes = (11, hidden, hidden, 3)
    made = {}
    for k in range(3):
        made[f"{k}_weights"] = random.normal(0, 0.5, (sizes[k], sizes[k + 1])).astype(np.float32)
        made[f"{k}_bias"] = random.normal(0, 0.5, sizes[k + 1]).astype(np.float32)
    return made


def mlp_json(**changes: Any) -> bytes:
    content = {name: array.tolist() for name, array in layers().items()} | {"obj_num": 1} | changes
    return json.dumps({key: value for key, value in content.items() if value is not None}).encode()


def textures(seed: int = 0, edge: int = EDGE) -> npt.NDArray[np.uint8]:
    """(edge, edge, 8) the PNGs' bytes: some texels in round groups are holes, and alpha is a/2 + 128."""
    random = np.random.default_rng(seed)
    y, x = np.mgrid[:edge, :edge]
    bytes_ = random.integers(1, 256, (edge, edge, 8)).astype(np.uint8)
    bytes_[..., (3, 7)] = bytes_[..., (3, 7)] // 2 + 128
    bytes_[..., 0][(x % 7 - 3) ** 2 + (y % 6 - 3) ** 2 < 5] = 0
    return bytes_


def obj(cells: tuple[int, ...] = (0, 1, 2), edge: int = EDGE) -> bytes:
    """The quads, each with the patch of its number: as the program writes them, with axes (x, z, -y)."""
    lines, across = [], edge // PATCH
    for number, cell in enumerate(cells):
        corner, along, down = QUADS[cell]
        points = [corner, corner + down, corner + along, corner + along + down]
        lines += [f"v {x:.6f} {z:.6f} {-y:.6f}" for x, y, z in points]
        left, top = (PATCH * (cell % across) + 0.5) / edge, (PATCH * (cell // across) + 0.5) / edge
        for i in range(4):
            lines.append(f"vt {left + (i // 2) * 16 / edge:.6f} {1 - top - (i % 2) * 16 / edge:.6f}")
        a, b, c, d = range(4 * number + 1, 4 * number + 5)
        lines += [f"f {a}/{a} {b}/{b} {d}/{d}", f"f {a}/{a} {d}/{d} {c}/{c}"]
    return ("\n".join(lines) + "\n").encode()


def phone_files(**files: bytes | None) -> dict[str, bytes]:
    """The files of a folder. Those given, with _ for dots, replace or add files; None removes a file."""
    bytes_ = textures()
    content: dict[str, bytes | None] = {
        "mlp.json": mlp_json(),
        "shape0.obj": obj(),
        "shape0.pngfeat0.png": encode_texture(np.ascontiguousarray(bytes_[..., :4])),
        "shape0.pngfeat1.png": encode_texture(np.ascontiguousarray(bytes_[..., 4:])),
    }
    content |= files
    return {name: data for name, data in content.items() if data is not None}


def phone_folder(path: Path, files: dict[str, bytes] | None = None) -> Path:
    path.mkdir(parents=True)
    for name, data in (phone_files() if files is None else files).items():
        (path / name).write_bytes(data)
    return path


def colour(features: Floats, directions: Floats) -> Floats:
    """(m, 3) what the MLP returns for (m, 8) features and (m, 3) directions, in double precision."""
    x = np.concatenate([features, directions], axis=1)
    for k in range(3):
        x = x @ layers()[f"{k}_weights"].astype(np.float64) + layers()[f"{k}_bias"]
        x = np.maximum(x, 0) if k < 2 else 1 / (1 + np.exp(-x))
    return x


def picture(camera: Camera, samples: int = 1, background: float = 1.0) -> tuple[Floats, Floats]:
    """The colours (H, W, 3) and the coverage (H, W), as MobileNeRF's viewer computes them."""
    fine = camera.part(slice(0, camera.width), slice(0, camera.height), finer=samples)
    origins, directions = fine.rays()
    inputs, nearest = np.zeros((len(directions), 11)), np.full(len(directions), np.inf)
    bytes_ = textures().astype(np.float64)
    for cell, (corner, along, down) in enumerate(QUADS.astype(np.float32).astype(np.float64)):
        matrix = np.stack(np.broadcast_arrays(along, down, -directions), axis=-1)
        s, t, far = np.linalg.solve(matrix, (np.broadcast_to(origins, directions.shape) - corner)[..., None])[..., 0].T
        met = (s >= 0) & (s <= 1) & (t >= 0) & (t <= 1) & (far > 0) & (far < nearest)
        column = PATCH * (cell % (EDGE // PATCH)) + (0.5 + 16 * s[met]).astype(int)
        row = PATCH * (cell // (EDGE // PATCH)) + (0.5 + 16 * t[met]).astype(int)
        texels = bytes_[row, column] / 255
        texels[:, (3, 7)] = 2 * texels[:, (3, 7)] - 1
        there = np.flatnonzero(met)[texels[:, 0] > 0]
        nearest[there] = far[there]
        inputs[there] = np.concatenate([texels[texels[:, 0] > 0], directions[there]], axis=1)

    def mean(values: Floats) -> Floats:
        blocks = values.reshape(camera.height, samples, camera.width, samples, -1)
        return np.asarray(blocks.mean(axis=(1, 3)))

    given, alpha = mean(inputs).reshape(-1, 11), mean(np.isfinite(nearest).astype(np.float64)).reshape(-1, 1)
    shown = colour(given[:, :8], given[:, 8:]) * alpha + background * (1 - alpha)
    return shown.reshape(camera.height, camera.width, 3), alpha.reshape(camera.height, camera.width)
