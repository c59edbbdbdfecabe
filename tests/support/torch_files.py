"""Synthetic DirectVoxGO checkpoints, as DirectVoxGO writes them with torch."""

from __future__ import annotations

from typing import Any

import numpy as np

from nerfbake.formats.wire.torch_writer import TensorView, numpy_array, ordered, torch_file
from tests.support.lattices import CENTRE, RADIUS, SHAPE, affine

FEATURES, WIDTH = 4, 8
ACT_SHIFT = -9.0
BASE = 1000.0  # voxels


def dvgo(
    *,
    mlp: str = "affine",
    dialect: str = "grid",
    direct: bool = True,
    features: int = FEATURES,
    shape: tuple[int, int, int] = SHAPE,
) -> dict[str, Any]:
    """A checkpoint.

    mlp      affine (no ReLU clips anything), random, or none (three channels of colour)
    dialect  grid; early (before April 2022, without act_shift); 2021 (before February 2022, positions in the MLP);
             planes (features are products of planes and vectors)
    """
    random = np.random.default_rng(4)
    low, high = (CENTRE - RADIUS).astype(np.float32), (CENTRE + RADIUS).astype(np.float32)
    axes = [np.linspace(a, b, edge) for a, b, edge in zip(low, high, shape, strict=True)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), -1)
    C = 3 if mlp == "none" else features + 3 * (not direct)
    k0 = random.normal(0, 0.5, (1, C, *shape)).astype(np.float32)
    dot = "" if dialect in ("early", "2021") else ".grid"
    state: dict[str, Any] = {
        "xyz_min": low,
        "xyz_max": high,
        f"density{dot}": affine(points).astype(np.float32)[None, None],
        f"k0{dot}": k0,
        "mask_cache.mask": np.ones((3, 4, 2), bool),
    }
    if dot:
        state["act_shift"] = np.array([ACT_SHIFT], np.float32)
    if mlp != "none":
        state |= weights(mlp, features, positions=dialect == "2021")
    settings = {
        "xyz_min": numpy_array(low),
        "xyz_max": numpy_array(high),
        "num_voxels": 4096,
        "num_voxels_base": int(BASE),
        "alpha_init": 1e-2,
        "voxel_size_ratio": np.float32(1.5),
        "fast_color_thres": {0: 1e-3, 1000: 1e-4},
        "rgbnet_dim": C,
        "rgbnet_direct": direct,
        "viewbase_pe": 4,
    }
    if dialect == "planes":
        del state["k0.grid"]
        state |= _planes(random, C, shape)
    if dialect == "2021":
        del state["mask_cache.mask"]
        state["mask_cache.density"] = np.ones((1, 1, 2, 2, 2), np.float32)
        flags = dict.fromkeys(("nearest", "pre_act_density", "in_act_density"), False)
        settings |= {"posbase_pe": 5, "mask_cache_path": "coarse_last.tar", **flags}
    optimizer = {"state": {0: {"exp_avg": TensorView(np.zeros(1, np.float32), 0, (9,), (1,), numel=9)}}}
    return {
        "global_step": 20000,
        "model_kwargs": settings,
        "model_state_dict": ordered(state),
        "optimizer_state_dict": optimizer,
    }


def _planes(random: Any, channels: int, shape: tuple[int, int, int]) -> dict[str, Any]:
    """The arrays of a TensoRFGrid: three components for the xy plane, two for each of the others."""
    X, Y, Z = shape
    sizes = {"xy_plane": (3, X, Y), "xz_plane": (2, X, Z), "yz_plane": (2, Y, Z), "z_vec": (3, Z, 1)}
    sizes |= {"y_vec": (2, Y, 1), "x_vec": (2, X, 1)}
    made = {f"k0.{name}": random.normal(0, 1, (1, *size)).astype(np.float32) for name, size in sizes.items()}
    return made | {"k0.f_vec": random.normal(0, 0.5, (7, channels)).astype(np.float32)}


def weights(mlp: str, features: int = FEATURES, *, positions: bool = False) -> dict[str, Any]:
    """The weights of an rgbnet with two hidden layers.

    affine: in the first layer only features and the direction have weights, and biases keep every unit positive.
    """
    random = np.random.default_rng(5)
    layers = [
        random.normal(0, 0.3, shape) for shape in ((WIDTH, features + 27 + 33 * positions), (WIDTH, WIDTH), (3, WIDTH))
    ]
    biases = [random.normal(0, 0.3, len(layer)) for layer in layers]
    if mlp == "affine":
        layers[0][:, features + 3 :] = 0
        biases[0] += 20
        biases[1] += 200
        biases[2] -= layers[2] @ (layers[1] @ biases[0] + biases[1])
    named: dict[str, Any] = {}
    for name, layer, bias in zip(("rgbnet.0", "rgbnet.2.0", "rgbnet.3"), layers, biases, strict=True):
        named |= {f"{name}.weight": layer.astype(np.float32), f"{name}.bias": bias.astype(np.float32)}
    more = {"posfreq": np.array([1, 2, 4, 8, 16], np.float32)} if positions else {}
    return named | {"viewfreq": np.array([1, 2, 4, 8], np.float32)} | more


def dvgo_file(checkpoint: dict[str, Any] | None = None) -> bytes:
    return torch_file(dvgo() if checkpoint is None else checkpoint, prefix="fine_last", location="cuda:0")
