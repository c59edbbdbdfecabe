"""Synthetic checkpoints of nerfacto and of nerfstudio's instant-ngp, and their formulas in plain NumPy, float32."""

from __future__ import annotations

from itertools import product
from typing import Any

import numpy as np

from nerfbake.formats.wire.torch_writer import ordered, torch_file

LEVELS, FEATURES, LOG2, BASE, MOST = 3, 2, 13, 16, 64
WIDTH, HEAD, APPEARANCE = 16, 16, 5
GROWTH = float(np.exp((np.log(MOST) - np.log(BASE)) / (LEVELS - 1)))
KEYS = {
    "torch": ("mlp_base.model.0.hash_table", "mlp_base.model.1.layers", "mlp_head.layers"),
    "torch 0.3": ("mlp_base.0.hash_table", "mlp_base.1.layers", "mlp_head.layers"),
    "tcnn": ("", "mlp_base.model.params", "mlp_head.tcnn_encoding.params"),
    "tcnn 0.3": (
        "mlp_base_grid.tcnn_encoding.params",
        "mlp_base_mlp.tcnn_encoding.params",
        "mlp_head.tcnn_encoding.params",
    ),
    "tcnn 0.3, as a sequence": (
        "mlp_base.0.tcnn_encoding.params",
        "mlp_base.1.tcnn_encoding.params",
        "mlp_head.tcnn_encoding.params",
    ),
    "tcnn 0.1": ("", "mlp_base.params", "mlp_head.params"),
}
SIZES = {"num_levels": LEVELS, "log2_hashmap_size": LOG2, "max_res": MOST}


def random(*shape: int, seed: int = 0, scale: float = 0.5) -> Any:
    return np.random.default_rng(seed).normal(0, scale, shape).astype(np.float32)


def tcnn_shapes(inputs: int, width: int, hidden: int, outputs: int) -> list[tuple[int, int]]:
    inputs, outputs = ((n + 15) // 16 * 16 for n in (inputs, outputs))
    return [(width, inputs), *[(width, width)] * (hidden - 1), (outputs, width)]


def tcnn_levels(levels: int, log2: int, base: int, growth: float) -> list[tuple[Any, int, int]]:
    """(scale, nodes along an axis, rows) of each level."""
    found = []
    log2_growth = np.float32(np.log2(np.float64(np.float32(growth))))  # log2f, as rounded as glibc's
    for level in range(levels):
        power = np.float32(np.exp2(np.float64(np.float32(level) * log2_growth)))  # exp2f
        scale = power * np.float32(base) - np.float32(1)
        nodes = int(np.ceil(scale)) + 1
        found.append((scale, nodes, min((nodes**3 + 7) // 8 * 8, 1 << log2)))
    return found


def nerfacto(
    layout: str = "torch", *, appearance: int = APPEARANCE, prefix: str = "_model.", log2: int = LOG2
) -> dict[str, Any]:
    """The root of a checkpoint."""
    grid, trunk, head = KEYS[layout]
    inputs, coded = LEVELS * FEATURES, 31 + appearance
    state: dict[str, Any] = {"aabb": np.array([[-1, -1, -1], [1, 1, 1]], np.float32)}
    if layout != "tcnn 0.1":
        state |= {key: np.array(value) for key, value in (SIZES | {"log2_hashmap_size": log2}).items()}
    if appearance:
        state["embedding_appearance.embedding.weight"] = random(3, appearance, seed=5)
    if layout.startswith("torch"):
        state[grid] = random(LEVELS << log2, FEATURES)
        for name, layers in ((trunk, [(WIDTH, inputs), (16, WIDTH)]), (head, [(HEAD, coded), (HEAD, HEAD), (3, HEAD)])):
            for k, shape in enumerate(layers):
                state[f"{name}.{k}.weight"] = random(*shape, seed=10 + k)
                state[f"{name}.{k}.bias"] = random(shape[0], seed=20 + k)
    else:
        rows = sum(rows for *_, rows in tcnn_levels(LEVELS, log2, BASE, GROWTH))
        table = random(rows * FEATURES)
        network = random(sum(a * b for a, b in tcnn_shapes(inputs, WIDTH, 1, 16)), seed=10)
        state |= {grid: table, trunk: network} if grid else {trunk: np.concatenate([network, table])}
        state[head] = random(sum(a * b for a, b in tcnn_shapes(coded, HEAD, 2, 3)), seed=11)
    fields = {f"{prefix}field.{key}": value for key, value in state.items()}
    others = {f"{prefix}device_indicator_param": np.zeros(1, np.float32), "step": 9}
    return {
        "step": 9,
        "pipeline": ordered(fields | others),
        "optimizers": {"fields": {"state": {}, "param_groups": []}},
    }


def ngp(layout: str = "tcnn") -> dict[str, Any]:
    """A checkpoint of nerfstudio's instant-ngp: two levels of 4^3 cells, the second box twice as large."""
    root = nerfacto(layout)
    cells = np.zeros((2, 4, 4, 4), bool)
    cells[0, 1, 2, 3] = cells[1, 0, 3, 1] = True
    root["pipeline"] |= {
        "_model.occupancy_grid.binaries": cells,
        "_model.occupancy_grid.aabbs": np.array([[-1] * 3 + [1] * 3, [-2] * 3 + [2] * 3], np.float32),
        "_model.occupancy_grid.occs": np.zeros(128, np.float32),
    }
    return root


def nerfstudio_file(root: dict[str, Any] | None = None) -> bytes:
    return torch_file(nerfacto() if root is None else root)


def run_files(root: dict[str, Any] | None = None, **settings: Any) -> dict[str, bytes]:
    """The files of a run. settings: of pipeline.model."""
    lines = [f"    {key}: {value}\n" for key, value in ({"base_res": BASE} | settings).items()]
    config = (
        "!!python/object:nerfstudio.engine.trainer.TrainerConfig\n"
        "_target: &id001 !!python/name:nerfstudio.engine.trainer.Trainer ''\n"
        "other: *id001\n"
        "output_dir: !!python/object/apply:os.system\n- 'false'\n"
        "pipeline: !!python/object:nerfstudio.pipelines.base_pipeline.VanillaPipelineConfig\n"
        "  model: !!python/object:nerfstudio.models.nerfacto.NerfactoModelConfig\n" + "".join(lines)
    )
    transforms = b'{"transform": [[0, 1, 0, 0.5], [0, 0, 1, 0], [1, 0, 0, -0.25]], "scale": 0.5}'
    return {
        "config.yml": config.encode(),
        "dataparser_transforms.json": transforms,
        "nerfstudio_models/step-000000009.ckpt": nerfstudio_file(root),
    }


# -- the formulas, in the order of the program -----------------------------------------------------------------
def torch_grid(table: Any, x: Any, log2: int = LOG2) -> Any:
    """(m, L F): floor and ceil of x times the level's resolution; all levels are hashed, in 64 bits."""
    growth = np.exp((np.log(MOST) - np.log(BASE)) / (LEVELS - 1))
    sizes = np.floor(BASE * np.float32(growth) ** np.arange(LEVELS, dtype=np.float32))
    found = []
    for level, size in enumerate(sizes.astype(np.float32)):
        q = x * size
        low, high = np.floor(q).astype(np.int64), np.ceil(q).astype(np.int64)
        weight = (q - np.floor(q)).astype(np.float32)
        value = np.zeros((len(x), FEATURES), np.float32)
        for corner in product((0, 1), repeat=3):
            at = np.where(corner, high, low)
            row = at[:, 0] ^ at[:, 1] * 2654435761 ^ at[:, 2] * 805459861
            row = level * (1 << log2) + row % (1 << log2)
            value += table[row] * np.where(corner, weight, 1 - weight).prod(axis=1, keepdims=True)
        found.append(value)
    return np.concatenate(found, axis=1)


def tcnn_grid(
    params: Any, x: Any, *, levels: int = LEVELS, log2: int = LOG2, base: int = BASE, growth: float = GROWTH, F: int = 2
) -> Any:
    """(m, L F): corners of x s + 1/2; dense levels have x fastest; all rows modulo their number."""
    found, begin = [], 0
    for scale, nodes, rows in tcnn_levels(levels, log2, base, growth):
        table = params[begin : begin + rows * F].reshape(rows, F)
        begin += rows * F
        q = (x * scale + np.float32(0.5)).astype(np.float32)
        corner0 = np.floor(q)
        weight = q - corner0
        value = np.zeros((len(x), F), np.float32)
        for corner in product((0, 1), repeat=3):
            i, j, k = (corner0 + corner).astype(np.uint32).T
            if nodes**3 <= rows:
                row = i + j * np.uint32(nodes) + k * np.uint32(nodes * nodes)
            else:
                row = i ^ (j * np.uint32(2654435761)) ^ (k * np.uint32(805459861))
            value += table[row % rows] * np.where(corner, weight, 1 - weight).prod(axis=1, keepdims=True)
        found.append(value)
    assert begin == len(params)
    return np.concatenate(found, axis=1)


def tcnn_mlp(params: Any, x: Any, *, width: int, hidden: int, outputs: int, fill: float = 1.0) -> Any:
    """(m, outputs): inputs are filled up with ones (behind a grid with zeros); no biases; ReLU between layers."""
    shapes, at = tcnn_shapes(x.shape[1], width, hidden, outputs), 0
    x = np.concatenate([x, np.full((len(x), shapes[0][1] - x.shape[1]), fill, np.float32)], axis=1)
    for number, (rows, columns) in enumerate(shapes):
        x = x @ params[at : at + rows * columns].reshape(rows, columns).T
        x = np.maximum(x, 0) if number + 1 < len(shapes) else x
        at += rows * columns
    assert at == len(params)
    return x[:, :outputs]


def torch_mlp(state: dict[str, Any], stem: str, count: int, x: Any) -> Any:
    for k in range(count):
        x = x @ state[f"{stem}.{k}.weight"].T + state[f"{stem}.{k}.bias"]
        x = np.maximum(x, 0) if k + 1 < count else x
    return x


def polynomials(d: Any, *, signs: bool) -> Any:
    """(m, 16): nerfstudio's own components_from_spherical_harmonics; signs: tiny-cuda-nn's, of unit directions."""
    x, y, z = d.astype(np.float64).T
    xx, yy, zz = x * x, y * y, z * z
    s = -1 if signs else 1
    rows = [
        0.28209479177387814 + 0 * x,
        s * 0.4886025119029199 * y,
        0.4886025119029199 * z,
        s * 0.4886025119029199 * x,
        1.0925484305920792 * x * y,
        s * 1.0925484305920792 * y * z,
        0.9461746957575601 * zz - 0.31539156525252005,
        s * 1.0925484305920792 * x * z,
        0.5462742152960396 * (xx - yy),
        s * 0.5900435899266435 * y * (3 * xx - yy),
        2.890611442640554 * x * y * z,
        s * 0.4570457994644658 * y * (5 * zz - 1),
        0.3731763325901154 * z * (5 * zz - 3),
        s * 0.4570457994644658 * x * (5 * zz - 1),
        1.445305721320277 * z * (xx - yy),
        s * 0.5900435899266435 * x * (xx - 3 * yy),
    ]
    return np.stack(rows, axis=1).astype(np.float32)


def contracted(points: Any) -> Any:
    """(m, 3) in the unit cube: the largest coordinate decides."""
    points = points.astype(np.float32)
    m = np.maximum(np.abs(points).max(axis=1, keepdims=True), 1)
    return ((2 - 1 / m) * (points / m) + 2) / 4


def reference(layout: str, root: dict[str, Any], points: Any, d: Any, appearance: Any) -> tuple[Any, Any]:
    """exp(h0) (m,) and colours (m, 3) at points in the unit cube, in unit directions."""
    grid, trunk, head = KEYS[layout]
    state = {key.partition("field.")[2]: value for key, value in root["pipeline"].items()}
    seen = np.broadcast_to(appearance, (len(points), len(appearance)))
    log2 = int(state.get("log2_hashmap_size", LOG2))
    if layout.startswith("torch"):
        h = torch_mlp(state, trunk, 2, torch_grid(state[grid], points, log2))
        code = polynomials((d + 1) / 2, signs=False)
        logits = torch_mlp(state, head, 3, np.concatenate([code, h[:, 1:], seen], axis=1))
    else:
        numbers = sum(a * b for a, b in tcnn_shapes(LEVELS * FEATURES, WIDTH, 1, 16))
        table, network = (state[grid], state[trunk]) if grid else (state[trunk][numbers:], state[trunk][:numbers])
        fill = 1.0 if grid else 0.0
        h = tcnn_mlp(network, tcnn_grid(table, points, log2=log2), width=WIDTH, hidden=1, outputs=16, fill=fill)
        inputs = np.concatenate([polynomials(d, signs=True), h[:, 1:], seen], axis=1)
        logits = tcnn_mlp(state[head], inputs, width=HEAD, hidden=2, outputs=3)
    return np.exp(h[:, 0]), 1 / (1 + np.exp(-logits))
