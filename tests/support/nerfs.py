"""Small checkpoints of NeRF's network as several programs write them, and what those programs compute of them.

The references evaluate a network in float64 with its inputs in the file's order, independently of nerfbake's networks.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import msgpack
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
    random = np.random.default_rng(seed)
    layers: Layers = {}
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


# -- JaxNeRF, NeRF-SH, NeRF-SG -----------------------------------------------------------------------------------
LOBES = 4


def jaxnerf(seed: int = 0, colour: str = "directions") -> dict[str, Any]:
    """Parameters. colour: directions, RGB, SH4 or SG: what the last layers compute."""
    sizes = [(WIDTH if k else CODE) + CODE * (k == SKIP) for k in range(DEPTH)]
    shapes = [*((size, WIDTH) for size in sizes), (WIDTH, 1)]
    if colour == "directions":
        shapes += [(WIDTH, WIDTH), (WIDTH + VIEW_CODE, VIEW), (VIEW, 3)]
    else:
        shapes += [(WIDTH, {"RGB": 3, "SH4": 12, "SG": 3 * LOBES}[colour])]
    random = np.random.default_rng(seed)
    parameters: dict[str, Any] = {}
    for name in ("MLP_0", "MLP_1"):
        layers = {}
        for k, (inputs, outputs) in enumerate(shapes):
            layer = linear(random, "x", outputs, inputs)
            layers[f"Dense_{k}"] = {"bias": layer["x.bias"], "kernel": np.ascontiguousarray(layer["x.weight"].T)}
        parameters[name] = dict(sorted(layers.items()))  # in the order of the keys, as in real files
    if colour == "SG":
        lobes = random.normal(0, 1, (LOBES, 3)).astype(np.float32)
        parameters |= {"sg_lambda": lobes[:, 0], "sg_mu_spher": lobes[:, 1:]}
    return parameters


def jaxnerf_file(parameters: dict[str, Any]) -> bytes:
    state = {"param_states": {"x": np.zeros(3, np.float32)}, "step": 7}
    return bytes(msgpack.packb({"optimizer": {"target": {"params": parameters}, "state": state}}, default=_flax))


def _flax(value: Any) -> Any:
    return msgpack.ExtType(1, msgpack.packb([value.shape, value.dtype.name, value.tobytes()]))


def sines_first(x: Any, count: int) -> Any:
    """JaxNeRF's code: all sines, frequency by frequency, then sines of the angles plus pi/2 in float32."""
    angles = np.concatenate([x.astype(np.float32) * np.float32(1 << k) for k in range(count)], axis=1)
    shifted = angles + np.float32(np.pi / 2)
    return np.concatenate([x, np.sin(angles.astype(float)), np.sin(shifted.astype(float))], axis=1)


def jaxnerf_answers(parameters: Any, points: Any, directions: Any, code: Any = sines_first) -> tuple[Any, Any]:
    """(m,) density and (m, 3) colour of the fine network."""
    layers = [parameters["MLP_1"][f"Dense_{k}"] for k in range(len(parameters["MLP_1"]))]

    def dense(k: int, x: Any) -> Any:
        return x @ layers[k]["kernel"].astype(float) + layers[k]["bias"]

    given = h = code(points, FREQUENCIES)
    for k in range(DEPTH):
        h = relu(dense(k, np.concatenate([h, given], axis=1) if k == SKIP else h))
    density, raw = relu(dense(DEPTH, h)[:, 0]), dense(DEPTH + 1, h)
    if len(layers) > DEPTH + 2:
        raw = relu(dense(DEPTH + 2, np.concatenate([raw, code(directions, VIEWS)], axis=1)))
        return density, sigmoid(dense(DEPTH + 3, raw))
    if "sg_lambda" in parameters:
        theta, phi = parameters["sg_mu_spher"].astype(float).T
        axes = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=1)
        lobes = np.exp(np.logaddexp(0, parameters["sg_lambda"].astype(float)) * (directions @ axes.T - 1))
        return density, sigmoid((raw.reshape(-1, 3, LOBES) * lobes[:, None]).mean(axis=2))
    if raw.shape[1] == 12:
        x, y, z = directions.T
        basis = np.stack([np.full_like(x, 0.28209479), -0.48860251 * y, 0.48860251 * z, -0.48860251 * x], axis=1)
        return density, sigmoid((raw.reshape(-1, 3, 4) * basis[:, None]).sum(axis=2))
    return density, sigmoid(raw)


# -- KiloNeRF ----------------------------------------------------------------------------------------------------
CELLS = (2, 1, 3)
DOMAIN = np.array([[-1.0, -0.5, 0.0], [1.0, 0.5, 1.5]])
KILONERF_YAML = "fixed_resolution: [2, 1, 3]\nglobal_domain_min: [-1, -0.5, 0]\nglobal_domain_max:\n- 1\n- 0.5\n- 1.5\n"


def kilonerf(seed: int = 0, *, bmm: bool = False) -> Layers:
    """bmm: weights (n, out, in), as its other implementation stores them."""
    random = np.random.default_rng(seed)
    layers: Layers = {}
    shapes = {"pts_linears.0": (CODE, WIDTH), "pts_linears.1": (WIDTH, WIDTH), "feature_linear": (WIDTH, WIDTH)}
    shapes |= {"alpha_linear": (WIDTH, 1), "direction_layer": (WIDTH + VIEW_CODE, VIEW), "rgb_linear": (VIEW, 3)}
    n = int(np.prod(CELLS))
    for name, (inputs, outputs) in shapes.items():
        each = [linear(random, name, outputs, inputs) for _ in range(n)]
        weight = np.stack([layer[f"{name}.weight"] for layer in each])
        layers[f"{name}.weight"] = weight if bmm else np.ascontiguousarray(weight.swapaxes(1, 2))
        layers[f"{name}.bias"] = np.stack([layer[f"{name}.bias"] for layer in each])
    return layers


def kilonerf_file(layers: Layers) -> bytes:
    return torch_file({"global_step": 7, "model_state_dict": ordered(layers)}, location="cuda:0")


def by_coordinate(x: Any, count: int) -> Any:
    """KiloNeRF's code: for each coordinate itself, its cosines, its sines."""
    angles = x[:, :, None] * 2.0 ** np.arange(count)
    return np.concatenate([x[:, :, None], np.cos(angles), np.sin(angles)], axis=2).reshape(len(x), -1)


def kilonerf_answers(layers: Layers, points: Any, directions: Any) -> tuple[Any, Any]:
    """(m,) density and (m, 3) colour at world points, one at a time; weights are (n, in, out)."""
    density, colour = np.zeros(len(points)), np.full((len(points), 3), 0.5)
    edge = (DOMAIN[1] - DOMAIN[0]) / CELLS
    for i, (point, direction) in enumerate(zip(points, directions, strict=True)):
        if not ((point > DOMAIN[0] + 0.001) & (point < DOMAIN[1] - 0.001)).all():
            continue
        x, y, z = cell = np.floor((point - DOMAIN[0]) / edge).astype(int)
        n = (x * CELLS[1] + y) * CELLS[2] + z
        own = {key: value[n].T for key, value in layers.items()}
        h = by_coordinate((2 * (point - DOMAIN[0] - cell * edge) / edge - 1)[None], FREQUENCIES)
        for name in ("pts_linears.0", "pts_linears.1"):
            h = relu(after(own, name, h))
        density[i] = relu(after(own, "alpha_linear", h)[0, 0])
        view = np.concatenate([after(own, "feature_linear", h), by_coordinate(direction[None], VIEWS)], axis=1)
        colour[i] = sigmoid(after(own, "rgb_linear", relu(after(own, "direction_layer", view))))[0]
    return density, colour


# -- damage that every reader has to refuse --------------------------------------------------------------------
def misfits(layers: Layers) -> Iterator[tuple[str, Layers]]:
    """Each array with one number less along its last axis, as whole numbers, and missing, with its name."""
    for key, array in layers.items():
        yield key, layers | {key: array[..., :-1]}
        yield key, layers | {key: array.astype(np.int32)}
        yield key, {name: value for name, value in layers.items() if name != key}
