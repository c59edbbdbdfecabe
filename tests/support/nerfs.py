"""Small checkpoints of NeRF's network as several programs write them, and what those programs compute of them.

The references evaluate a network in float64 with its inputs in the file's order, independently of nerfbake's networks.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from nerfbake.formats.wire.torch_writer import ordered, torch_file

WIDTH, DEPTH, VIEW = (
    6,
    4,
    5,
)  # units; layers for positions, of which layer 3 also takes the code; units of the view layer
FREQUENCIES, VIEWS = 3, 2  # of positions and of directions
CODE, VIEW_CODE = 3 + 6 * FREQUENCIES, 3 + 6 * VIEWS
SKIP = 3
RANDOM = np.random.default_rng(4)
POINTS = RANDOM.uniform(-1.4, 1.4, (200, 3)).astype(np.float32).astype(float)
DIRECTIONS = (turned := RANDOM.normal(size=(200, 3))) / np.sqrt((turned**2).sum(axis=1, keepdims=True))

Layers = dict[str, Any]


def linear(random: Any, name: str, outputs: int, inputs: int) -> Layers:
    """One of torch's layers, with enough bias that both signs of every output occur."""
    weight = random.normal(0, 1.2 / np.sqrt(inputs), (outputs, inputs)).astype(np.float32)
    return {f"{name}.weight": weight, f"{name}.bias": random.normal(0, 0.4, outputs).astype(np.float32)}


def after(layers: Layers, name: str, x: Any) -> Any:
    """(m, out) the layer's outputs for inputs (m, in)."""
    return x @ layers[f"{name}.weight"].astype(float).T + layers[f"{name}.bias"]


def relu(x: Any) -> Any:
    return np.maximum(x, 0)


def sigmoid(x: Any) -> Any:
    return 1 / (1 + np.exp(-x))


# -- nerf-pytorch ----------------------------------------------------------------------------------------------
def nerf_pytorch(seed: int = 0, *, directions: bool = True) -> Layers:
    random = np.random.default_rng(seed)
    layers: Layers = {}
    for k in range(DEPTH):
        inputs = CODE if k == 0 else WIDTH + CODE * (k == SKIP)
        layers |= linear(random, f"pts_linears.{k}", WIDTH, inputs)
    layers |= linear(random, "views_linears.0", VIEW, WIDTH + VIEW_CODE)  # also without directions
    if not directions:
        return layers | linear(random, "output_linear", 5, WIDTH)
    layers |= linear(random, "feature_linear", WIDTH, WIDTH) | linear(random, "alpha_linear", 1, WIDTH)
    return layers | linear(random, "rgb_linear", 3, VIEW)


def nerf_pytorch_file(fine: Layers | None, coarse: Layers | None = None) -> bytes:
    root = {
        "global_step": 7,
        "network_fn_state_dict": ordered(nerf_pytorch(9) if coarse is None else coarse),
        "network_fine_state_dict": None if fine is None else ordered(fine),
        "optimizer_state_dict": {"state": {}},
    }
    return torch_file(root, prefix="000007", location="cuda:0")


def by_frequency(x: Any, count: int) -> Any:
    return np.concatenate([x, *(f(2.0**k * x) for k in range(count) for f in (np.sin, np.cos))], axis=1)


def nerf_pytorch_answers(layers: Layers, points: Any, directions: Any) -> tuple[Any, Any]:
    """(m,) density and (m, 3) colour."""
    code = by_frequency(points, FREQUENCIES)
    h = code
    for k in range(DEPTH):
        h = relu(after(layers, f"pts_linears.{k}", np.concatenate([code, h], axis=1) if k == SKIP else h))
    if "output_linear.weight" in layers:
        both = after(layers, "output_linear", h)
        return relu(both[:, 3]), sigmoid(both[:, :3])
    view = np.concatenate([after(layers, "feature_linear", h), by_frequency(directions, VIEWS)], axis=1)
    colour = after(layers, "rgb_linear", relu(after(layers, "views_linears.0", view)))
    return relu(after(layers, "alpha_linear", h)[:, 0]), sigmoid(colour)


# -- nerfstudio's vanilla-nerf ---------------------------------------------------------------------------------
def vanilla_nerf(seed: int = 0) -> Layers:
    random, layers = np.random.default_rng(seed), {}
    for field in ("field_coarse", "field_fine"):
        for k in range(DEPTH):
            inputs = CODE if k == 0 else WIDTH + CODE * (k == SKIP)
            layers |= linear(random, f"{field}.mlp_base.layers.{k}", WIDTH, inputs)
        layers |= linear(random, f"{field}.field_output_density.net", 1, WIDTH)
        layers |= linear(random, f"{field}.mlp_head.layers.0", VIEW, VIEW_CODE + WIDTH)
        layers |= linear(random, f"{field}.mlp_head.layers.1", VIEW, VIEW)
        layers |= linear(random, f"{field}.field_heads.0.net", 3, VIEW)
    return layers


def vanilla_nerf_file(layers: Layers) -> bytes:
    state = {f"_model.{key}": value for key, value in layers.items()}
    root = {"step": 7, "pipeline": ordered({"_model.device_indicator_param": np.zeros(1, np.float32), **state})}
    return torch_file(root, location="cuda:0")


def input_last(x: Any, count: int, highest: float) -> Any:
    """nerfstudio's code: the frequencies of x, of y, of z, in float32 as the program has them."""
    frequencies = (2.0 ** np.linspace(0, highest, count)).astype(np.float32)
    angles = (np.float32(2 * np.pi) * x.astype(np.float32))[:, :, None] * frequencies
    angles = angles.reshape(len(x), -1)
    shifted = angles + np.float32(np.pi / 2)
    return np.concatenate([np.sin(angles.astype(float)), np.sin(shifted.astype(float)), x], axis=1)


def vanilla_nerf_answers(layers: Layers, points: Any, directions: Any) -> tuple[Any, Any]:
    """(m,) density and (m, 3) colour of the fine field."""
    layers = {key.removeprefix("field_fine."): value for key, value in layers.items() if key.startswith("field_fine.")}
    code = input_last(points, FREQUENCIES, 8)
    h = code
    for k in range(DEPTH):
        h = relu(after(layers, f"mlp_base.layers.{k}", np.concatenate([code, h], axis=1) if k == SKIP else h))
    density = np.logaddexp(0, after(layers, "field_output_density.net", h)[:, 0])
    h = np.concatenate([input_last(directions, VIEWS, 4), h], axis=1)
    for k in range(2):
        h = relu(after(layers, f"mlp_head.layers.{k}", h))
    return density, sigmoid(after(layers, "field_heads.0.net", h))


# -- damage that every reader has to refuse --------------------------------------------------------------------
def misfits(layers: Layers) -> Iterator[tuple[str, Layers]]:
    """Each array with one number less along its last axis, as whole numbers, and missing, with its name."""
    for key, array in layers.items():
        yield key, layers | {key: array[..., :-1]}
        yield key, layers | {key: array.astype(np.int32)}
        yield key, {name: value for name, value in layers.items() if name != key}
