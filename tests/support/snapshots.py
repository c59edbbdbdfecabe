"""Synthetic snapshots of instant-ngp, as its JSON library writes them, and their formulas in plain NumPy, float32."""

from __future__ import annotations

from typing import Any

import msgpack
import numpy as np

from nerfbake.scene.camera import look_at
from tests.support.nerfstudio import polynomials, random, tcnn_grid, tcnn_levels, tcnn_mlp, tcnn_shapes

LEVELS, FEATURES, LOG2, BASE, WIDTH, HEAD = 3, 4, 7, 5, 16, 16
CELLS = 128**3
SCALE, OFFSET = 0.25, (0.5, 0.375, 0.625)


def growth(A: int) -> Any:
    """Of the levels, in float32 after each operation."""
    ratio = np.float32(2048.0 * A) / np.float32(BASE)
    return np.exp(np.float32(np.log(ratio)) / np.float32(LEVELS - 1), dtype=np.float32)


def parameters(A: int = 2) -> tuple[Any, Any, Any]:
    """The flat parameters of the two networks, and of the grid."""
    rows = sum(rows for *_, rows in tcnn_levels(LEVELS, LOG2, BASE, growth(A)))
    first = sum(a * b for a, b in tcnn_shapes(LEVELS * FEATURES, WIDTH, 1, 16))
    second = sum(a * b for a, b in tcnn_shapes(32, HEAD, 2, 3))
    sizes = first, second, rows * FEATURES
    return tuple(random(size, seed=30 + k).astype(np.float16).astype(np.float32) for k, size in enumerate(sizes))


def snapshot(
    A: int = 2, *, grid: Any = None, half: bool = True, dataset: dict[str, Any] | None = None, **more: Any
) -> dict[str, Any]:
    """The map of a snapshot. grid: values of the density grid; None: 1 in every cell; more: of `snapshot`."""
    params = np.concatenate(parameters(A))
    values = np.ones(A.bit_length() * CELLS) if grid is None else grid
    network = {"otype": "FullyFusedMLP", "activation": "ReLU", "output_activation": "None"}
    facts = {
        "n_images": 0,
        "paths": [],
        "scale": SCALE,
        "offset": list(OFFSET),
        "aabb_scale": A,
        "from_mitsuba": False,
        "is_hdr": False,
        "up": [0.0, 1.0, 0.0],
        "envmap_resolution": [0, 0],
        "n_extra_learnable_dims": 0,
    }
    harmonics = {"n_dims_to_encode": 3, "otype": "SphericalHarmonics", "degree": 4}
    return {
        "dir_encoding": {"otype": "Composite", "nested": [harmonics, {"otype": "Identity"}]},
        "encoding": {
            "otype": "HashGrid",
            "n_levels": LEVELS,
            "n_features_per_level": FEATURES,
            "log2_hashmap_size": LOG2,
            "base_resolution": BASE,
        },
        "network": network | {"n_neurons": WIDTH, "n_hidden_layers": 1},
        "rgb_network": network | {"n_neurons": HEAD, "n_hidden_layers": 2},
        "snapshot": {
            "background_color": [0.25, 0.5, 0.75, 1.0],
            "density_grid_binary": np.asarray(values, "<f2").tobytes(),
            "density_grid_size": 128,
            "mode": "nerf",
            "n_params": len(params),
            "nerf": {"aabb_scale": A, "dataset": facts | (dataset or {})},
            "optimizer": {"base_step": 3, "first_moments_binary": bytes(100)},
            "params_binary": params.astype("<f2" if half else "<f4").tobytes(),
            "params_type": "__half" if half else "float",
            "version": 1,
            **more,
        },
    }


def seen_by(count: int) -> dict[str, Any]:
    """The part of a data set with cameras around its centre."""
    poses = [to_ngp(look_at(np.zeros(3), 2.0 * i, 0.5, 3.0)).tolist() for i in range(count)]
    lens = {"is_fisheye": False, "k1": 0.1, "k2": 0.0, "p1": 0.01, "p2": 0.0}
    facts = {"focal_length": [50.0, 60.0], "principal_point": [0.5, 0.25], "resolution": [40, 20], "lens": lens}
    xforms = [{"start": pose, "end": pose} for pose in poses]
    return {
        "n_images": count,
        "xforms": xforms,
        "metadata": [facts] * count,
        "paths": [f"a/{i}.jpg" for i in range(count)],
    }


def snapshot_file(root: dict[str, Any] | None = None) -> bytes:
    return bytes(msgpack.packb(snapshot() if root is None else root))


def reference(points: Any, d: Any, A: int = 2) -> tuple[Any, Any]:
    """Density (m,) per unit of the trained coordinates, and colours (m, 3), at points and directions in these."""
    first, second, table = parameters(A)
    x = (points.astype(np.float32) - np.float32(0.5 - A / 2)) / np.float32(A)
    code = tcnn_grid(table, x, levels=LEVELS, log2=LOG2, base=BASE, growth=growth(A), F=FEATURES)
    h = tcnn_mlp(first, code, width=WIDTH, hidden=1, outputs=16, fill=0.0)
    inputs = np.concatenate([h, polynomials(d, signs=True)], axis=1)
    logits = tcnn_mlp(second, inputs, width=HEAD, hidden=2, outputs=3)
    return np.exp(h[:, 0]), 1 / (1 + np.exp(-logits))


def to_ngp(pose: Any, scale: float = SCALE, offset: Any = OFFSET) -> Any:
    """(3, 4) camera in the trained coordinates, of a pose (4, 4) with OpenGL's axes: nerf_matrix_to_ngp()."""
    out = pose[:3].copy()
    out[:, 1] *= -1
    out[:, 2] *= -1
    out[:, 3] = out[:, 3] * scale + offset
    return out[[1, 2, 0]]


def morton(x: int, y: int, z: int) -> int:
    return sum((x >> k & 1) << 3 * k | (y >> k & 1) << 3 * k + 1 | (z >> k & 1) << 3 * k + 2 for k in range(7))
