"""A trained field to check by hand: its density is linear in |x| + |y| + |z|, its logits in the direction."""

from __future__ import annotations

from typing import Any

import numpy as np

from nerfbake.scene.function_field import FunctionField
from nerfbake.scene.lattice_field import Activation
from nerfbake.scene.network import BasisColour, Frequencies, HeadColour, Mlp, Network
from tests.support.nerfs import DEPTH, nerf_pytorch, nerf_pytorch_file

DENSITY, REACH = 12.0, 0.8  # in the middle, and where it ends along an axis
LEAN = np.array([[1.5, 0.0, 0.0], [0.0, -1.0, 0.0], [0.5, 0.0, 1.0]])  # logits per direction
TURN = np.array([[0.0, -2.0, 0.0, 0.5], [2.0, 0.0, 0.0, -0.25], [0.0, 0.0, 2.0, 0.125]])  # a quarter turn about z


def density_at(points: Any, floor: float = 0.0) -> Any:
    """(m,) the density at points (m, 3)."""
    return np.maximum(np.maximum(1 - np.abs(points).sum(axis=1) / REACH, 0) * DENSITY, floor)


def soft_field(*, sh: bool = False, floor: float = 0.0, **others: Any) -> FunctionField:
    """A field in the cube from -1 to 1. sh: its network computes coefficients. floor: the density everywhere else."""
    sides = np.concatenate([np.eye(3), -np.eye(3)]).astype(np.float32)
    fall = np.full((1, 6), -DENSITY / REACH, np.float32)
    nothing = np.zeros(6, np.float32)
    # relu(density - floor), and then the floor is added.
    trunk = Mlp((sides, fall), (nothing, np.full(1, DENSITY - floor, np.float32)), rectified=True)
    if sh:
        colour: Any = BasisColour(Mlp((np.zeros((12, 1), np.float32),), (soft_coefficients(),)))
    else:
        lean = np.concatenate([np.zeros((3, 1)), LEAN], axis=1).astype(np.float32)
        colour = HeadColour(Mlp((lean,), (np.zeros(3, np.float32),)), Frequencies(np.zeros(0)))
    network = Network(Frequencies(np.zeros(0)), trunk, np.ones(1, np.float32), floor, Activation("relu"), colour)
    given: dict[str, Any] = {"frame": np.eye(3, 4), "box": np.array([[-1.0] * 3, [1.0] * 3])}
    return FunctionField(network, **given | others)


def soft_coefficients() -> Any:
    """(12,) float32 SH4 of red, of green, of blue: Y1 is (-y, z, -x) times sqrt(3 / 4 pi)."""
    each = np.stack([0 * LEAN[:, 0], -LEAN[:, 1], LEAN[:, 2], -LEAN[:, 0]], axis=1)
    return (each / np.sqrt(3 / (4 * np.pi))).astype(np.float32).reshape(-1)


def soft_file() -> bytes:
    """The density as a checkpoint of nerf-pytorch, with colours that hardly depend on the direction."""
    layers = {name: 0.02 * value for name, value in nerf_pytorch().items()}
    width = len(layers["pts_linears.0.bias"])
    for k in range(DEPTH):
        weight = np.zeros_like(layers[f"pts_linears.{k}.weight"])
        if k == 0:
            weight[:3, :3], weight[3:6, :3] = np.eye(3), -np.eye(3)
        else:
            weight[:6, weight.shape[1] - width : weight.shape[1] - width + 6] = np.eye(6)
        layers[f"pts_linears.{k}.weight"], layers[f"pts_linears.{k}.bias"] = weight, np.zeros(width, np.float32)
    fall = np.zeros((1, width), np.float32)
    fall[0, :6] = -DENSITY / REACH
    layers["alpha_linear.weight"], layers["alpha_linear.bias"] = fall, np.full(1, DENSITY, np.float32)
    return nerf_pytorch_file(layers)
