"""Synthetic checkpoints of torch-ngp, and their formulas in plain NumPy, float32."""

from __future__ import annotations

from itertools import product
from typing import Any

import numpy as np

from nerfbake.formats.wire.torch_writer import ordered, torch_file
from tests.support.nerfstudio import polynomials, random, torch_mlp

LEVELS, LOG2, BASE = 3, 13, 16
CELLS = 128**3


def torch_ngp(bound: float = 2.0, *, occupied: Any = None, log2: int = LOG2) -> dict[str, Any]:
    """The root of a checkpoint. occupied: numbers of cells of the bitfield; None: without occupancy."""
    growth, offsets = np.exp2(np.log2(2048 * bound / BASE) / (LEVELS - 1)), [0]
    for level in range(LEVELS):
        nodes = int(np.ceil(BASE * growth**level)) + 1
        offsets.append(offsets[-1] + int(np.ceil(min(1 << log2, nodes**3) / 8) * 8))
    state = {
        "aabb_train": np.array([-bound] * 3 + [bound] * 3, np.float32),
        "encoder.embeddings": random(offsets[-1], 2),
        "encoder.offsets": np.array(offsets, np.int32),
    }
    shapes = {"sigma_net": [(16, 2 * LEVELS), (16, 16)], "color_net": [(16, 31), (16, 16), (3, 16)]}
    for stem, layers in shapes.items():
        state |= {f"{stem}.{k}.weight": random(*shape, seed=40 + k) for k, shape in enumerate(layers)}
    if occupied is not None:
        flags = np.zeros(CELLS * (1 + max(int(np.ceil(np.log2(bound))), 0)), bool)
        flags[occupied] = True
        state["density_bitfield"] = np.packbits(flags, bitorder="little")
        state["density_grid"] = np.zeros((1, 8), np.float32)
    return {"epoch": 3, "global_step": 9, "stats": {"loss": [0.5]}, "model": ordered(state)}


def torch_ngp_file(root: dict[str, Any] | None = None) -> bytes:
    return torch_file(torch_ngp() if root is None else root)


def reference(root: dict[str, Any], points: Any, d: Any, bound: float = 2.0) -> tuple[Any, Any]:
    """Density (m,) per unit of the trained coordinates, and colours (m, 3), at points and directions in these."""
    state = root["model"]
    x = ((points.astype(np.float32) + np.float32(bound)) / np.float32(2 * bound)).astype(np.float32)
    S = np.float32(np.log2(np.exp2(np.log2(2048 * bound / BASE) / (LEVELS - 1))))
    found = []
    for level in range(LEVELS):
        begin, end = state["encoder.offsets"][level : level + 2]
        table, rows = state["encoder.embeddings"][begin:end], int(end - begin)
        scale = np.float32(np.exp2(np.float64(np.float32(level) * S))) * np.float32(BASE) - np.float32(1)
        stride = int(np.ceil(scale)) + 2
        q = x * scale + np.float32(0.5)
        low, value = np.floor(q), np.zeros((len(x), 2), np.float32)
        for corner in product((0, 1), repeat=3):
            i, j, k = (low + corner).astype(np.uint32).T
            row = i + j * np.uint32(stride) + k * np.uint32(stride * stride)
            if stride**3 > rows:
                row = i ^ (j * np.uint32(2654435761)) ^ (k * np.uint32(805459861))
            value += table[row % rows] * np.where(corner, q - low, 1 - (q - low)).prod(axis=1, keepdims=True)
        found.append(value)
    zeros = {f"{key.removesuffix('weight')}bias": np.float32(0) for key in state if key.endswith(".weight")}
    h = torch_mlp(state | zeros, "sigma_net", 2, np.concatenate(found, axis=1))
    inputs = np.concatenate([polynomials(d, signs=True), h[:, 1:]], axis=1)
    return np.exp(h[:, 0]), 1 / (1 + np.exp(-torch_mlp(state | zeros, "color_net", 3, inputs)))
