"""Synthetic TensoRF checkpoints: planes and lines of unequal sizes, an MLP of features and direction, and a mask.

The reference functions evaluate them at any point by their formulas, in float64, without a lattice.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from nerfbake.formats.wire.torch_writer import numpy_array, ordered, torch_file
from tests.support.lattices import CENTRE, RADIUS, SHAPE

PARTS, LOOKS, FEATURES, WIDTH = (2, 3, 2), (3, 2, 1), 4, 8
ACROSS = ((0, 1), (0, 2), (1, 2))  # the axes of each plane; its line has the third axis
ALONG = (2, 1, 0)
MASK = (4, 3, 5)
PES = {"view_pe": 2, "fea_pe": 3}
MASKED = np.zeros(MASK[::-1], bool)  # z, y, x
MASKED[2, 1, 1] = MASKED[4, 2, 3] = True
MASK_BOX = np.stack([CENTRE - 1.25 * RADIUS, CENTRE + RADIUS * (0.875, 1, 1.125)]).astype(np.float32)


def tensorf(*, mode: str = "MLP_Fea", masked: bool = True, act: str = "softplus") -> dict[str, Any]:
    """A checkpoint. mode: its shadingMode; masked: with a mask, whose box differs from the lattice's."""
    random = np.random.default_rng(9)
    features = 27 if mode == "SH" else FEATURES
    state: dict[str, Any] = {}
    for what, parts in (("density", PARTS), ("app", LOOKS)):
        for i, (first, second) in enumerate(ACROSS):
            size = SHAPE[second], SHAPE[first]
            state[f"{what}_plane.{i}"] = random.normal(1, 0.5, (1, parts[i], *size)).astype(np.float32)
        for i, axis in enumerate(ALONG):
            state[f"{what}_line.{i}"] = random.normal(0.5, 0.5, (1, parts[i], SHAPE[axis], 1)).astype(np.float32)
    state["basis_mat.weight"] = random.normal(0, 0.4, (features, sum(LOOKS))).astype(np.float32)
    if mode.startswith("MLP"):
        state |= _weights(random, 3 + 6 * PES["view_pe"] + FEATURES * (1 + 2 * PES["fea_pe"] * (mode == "MLP_Fea")))
    box = np.stack([CENTRE - RADIUS, CENTRE + RADIUS]).astype(np.float32)
    settings = {
        "aabb": box,
        "gridSize": list(SHAPE),
        "density_n_comp": list(PARTS),
        "appearance_n_comp": list(LOOKS),
        "app_dim": features,
        "density_shift": -1,
        "alphaMask_thres": 1e-4,
        "distance_scale": 25.0,
        "rayMarch_weight_thres": 1e-4,
        "fea2denseAct": act,
        "near_far": [2.0, 6.0],
        "step_ratio": 0.5,
        "shadingMode": mode,
        "pos_pe": 6,
        **PES,
        "featureC": WIDTH,
    }
    root: dict[str, Any] = {"kwargs": settings, "state_dict": ordered(state)}
    if masked:
        packed = numpy_array(np.packbits(MASKED.reshape(-1)))
        root |= {"alphaMask.shape": (1, 1, *MASKED.shape), "alphaMask.mask": packed, "alphaMask.aabb": MASK_BOX}
    return root


def _weights(random: Any, inputs: int) -> dict[str, Any]:
    named: dict[str, Any] = {}
    for number, shape in (("0", (WIDTH, inputs)), ("2", (WIDTH, WIDTH)), ("4", (3, WIDTH))):
        named[f"renderModule.mlp.{number}.weight"] = random.normal(0, 0.3, shape).astype(np.float32)
        named[f"renderModule.mlp.{number}.bias"] = random.normal(0, 0.3, shape[0]).astype(np.float32)
    return named


def tensorf_file(checkpoint: dict[str, Any] | None = None) -> bytes:
    return torch_file(tensorf() if checkpoint is None else checkpoint, location="cuda:0")


# -- reference values -----------------------------------------------------------------------------------------
def dense(checkpoint: dict[str, Any], what: str) -> Any:
    """(parts, X, Y, Z) the products of planes and lines at the nodes."""
    state = checkpoint["state_dict"]
    planes, lines = ([state[f"{what}_{kind}.{i}"][0].astype(float) for i in range(3)] for kind in ("plane", "line"))
    formulas = ("ryx,rz->rxyz", "rzx,ry->rxyz", "rzy,rx->rxyz")
    return np.concatenate([np.einsum(f, p, q[:, :, 0]) for f, p, q in zip(formulas, planes, lines, strict=True)])


def density_at(checkpoint: dict[str, Any], points: Any) -> Any:
    """(m,) the density per world unit at world points (m, 3). Planes and lines are interpolated, then multiplied."""
    settings = checkpoint["kwargs"]
    low, high = settings["aabb"].astype(float)
    raw = parts_at(checkpoint, "density", (points - low) / (high - low)).sum(axis=1)
    if settings["fea2denseAct"] == "relu":
        density = np.maximum(raw, 0)
    else:
        density = np.logaddexp(0, raw + settings["density_shift"])
    inside = ((points >= low) & (points <= high)).all(axis=1) & in_mask(checkpoint, points)
    return settings["distance_scale"] * np.where(inside, density, 0)


def parts_at(checkpoint: dict[str, Any], what: str, shares: Any) -> Any:
    """(m, parts) the products at coordinates (m, 3), from 0 to 1 across the box."""
    state, found = checkpoint["state_dict"], []
    hats = [
        np.maximum(1 - np.abs(shares[:, [axis]] * (edge - 1) - np.arange(edge)), 0) for axis, edge in enumerate(SHAPE)
    ]
    for i, ((first, second), axis) in enumerate(zip(ACROSS, ALONG, strict=True)):
        plane, line = state[f"{what}_plane.{i}"][0], state[f"{what}_line.{i}"][0, :, :, 0]
        across = np.einsum("rba,ma,mb->mr", plane.astype(float), hats[first], hats[second])
        found.append(across * np.einsum("rc,mc->mr", line.astype(float), hats[axis]))
    return np.concatenate(found, axis=1)


def in_mask(checkpoint: dict[str, Any], points: Any) -> Any:
    """(m,) True where the trilinear value of the mask is above 0."""
    if "alphaMask.aabb" not in checkpoint:
        return np.ones(len(points), bool)
    low, high = checkpoint["alphaMask.aabb"].astype(float)
    at = (points - low) / (high - low) * (np.array(MASK) - 1)
    x, y, z = (np.maximum(1 - np.abs(at[:, [axis]] - np.arange(edge)), 0) for axis, edge in enumerate(MASK))
    return np.einsum("zyx,mx,my,mz->m", MASKED.astype(float), x, y, z) > 0


def colour_at(checkpoint: dict[str, Any], points: Any, direction: Any) -> Any:
    """(m, 3) the colour at world points in one direction, with the inputs in the MLP's order."""
    settings, state = checkpoint["kwargs"], checkpoint["state_dict"]
    low, high = settings["aabb"].astype(float)
    features = parts_at(checkpoint, "app", (points - low) / (high - low)) @ state["basis_mat.weight"].T.astype(float)
    d = np.broadcast_to(np.asarray(direction, float), (len(points), 3))
    inputs = [features, d]
    if settings["shadingMode"] == "MLP_Fea":
        inputs += _sines(features, settings["fea_pe"])
    x = np.concatenate(inputs + _sines(d, settings["view_pe"]), axis=1)
    for number in "024":
        x = x @ state[f"renderModule.mlp.{number}.weight"].T.astype(float) + state[f"renderModule.mlp.{number}.bias"]
        x = np.maximum(x, 0) if number != "4" else x
    return 1 / (1 + np.exp(-x))


def _sines(x: Any, count: int) -> list[Any]:
    angles = (x[..., None] * 2.0 ** np.arange(count)).reshape(len(x), -1)
    return [np.sin(angles), np.cos(angles)]
