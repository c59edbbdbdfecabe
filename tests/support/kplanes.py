"""Synthetic checkpoints of K-Planes in nerfstudio, and their formulas in plain NumPy."""

from __future__ import annotations

from typing import Any

import numpy as np

from nerfbake.formats.wire.torch_writer import ordered, torch_file
from tests.support.nerfstudio import polynomials, random, tcnn_mlp, tcnn_shapes

SCALES, CHANNELS, WIDTH = ((4, 3, 5), (8, 6, 10)), 3, 32
BOX = np.array([[-1.5, -1, -2], [1.5, 1, 1]], np.float32)


def kplanes(*, concatenated: bool = True, appearance: int = 0, axes: int = 3) -> dict[str, Any]:
    """The root of a checkpoint. axes: 4 with a time axis."""
    state: dict[str, Any] = {"aabb": BOX}
    for s, nodes in enumerate(SCALES):
        pairs = [(a, b) for a in range(axes) for b in range(a + 1, axes)]
        for c, (a, b) in enumerate(pairs):
            sizes = (*nodes, 7)
            shape = CHANNELS, sizes[b], sizes[a]
            state[f"grids.{s}.plane_coefs.{c}"] = 1 + random(*shape, seed=60 + 10 * s + c)
    features = CHANNELS * (len(SCALES) if concatenated else 1)
    layers = {"sigma_net": (features, 1, 16), "color_net": (31 + appearance, 2, 3)}
    for k, (name, (inputs, hidden, outputs)) in enumerate(layers.items()):
        count = sum(rows * columns for rows, columns in tcnn_shapes(inputs, WIDTH, hidden, outputs))
        state[f"{name}.params"] = random(count, seed=80 + k, scale=0.3)
    if appearance:
        state["appearance_ambedding.embedding.weight"] = random(4, appearance, seed=90)
    return {"step": 3, "pipeline": ordered({f"_model.field.{key}": value for key, value in state.items()})}


def kplanes_file(root: dict[str, Any] | None = None) -> bytes:
    return torch_file(kplanes() if root is None else root)


def grid_features(root: dict[str, Any], x: Any, *, concatenated: bool = True) -> Any:
    """(m, features) at coordinates (m, 3) from -1 to 1; those outside have the values at the faces."""
    state, found = root["pipeline"], []
    for s in range(len(SCALES)):
        product = 1.0
        for c, (a, b) in enumerate(((0, 1), (0, 2), (1, 2))):
            plane = state[f"_model.field.grids.{s}.plane_coefs.{c}"].astype(float)
            hats = []
            for axis, edge in ((a, plane.shape[2]), (b, plane.shape[1])):
                at = np.clip((x[:, axis] + 1) / 2, 0, 1) * (edge - 1)
                hats.append(np.maximum(1 - np.abs(at[:, None] - np.arange(edge)), 0))
            product = product * np.einsum("cba,ma,mb->mc", plane, *hats)
        found.append(product)
    return np.concatenate(found, axis=1) if concatenated else sum(found)


def reference(root: dict[str, Any], x: Any, d: Any, *, concatenated: bool = True) -> tuple[Any, Any]:
    """Density (m,) per unit of the trained coordinates, and colours (m, 3): features first, the density last, -1."""
    state = root["pipeline"]
    features = grid_features(root, x, concatenated=concatenated)
    h = tcnn_mlp(state["_model.field.sigma_net.params"], features, width=WIDTH, hidden=1, outputs=16)
    table = state.get("_model.field.appearance_ambedding.embedding.weight", np.zeros((1, 0)))
    seen = np.broadcast_to(table.mean(axis=0), (len(x), table.shape[1]))
    inputs = np.concatenate([polynomials(d, signs=True), h[:, :15], seen], axis=1)
    logits = tcnn_mlp(state["_model.field.color_net.params"], inputs, width=WIDTH, hidden=2, outputs=3)
    return np.exp(h[:, 15] - 1), 1 / (1 + np.exp(-logits))
