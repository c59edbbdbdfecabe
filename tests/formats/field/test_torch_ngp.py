"""torch-ngp's checkpoints: formulas, its own dense levels, occupancy as bits, the world, and what is refused."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from nerfbake import FunctionField, load
from nerfbake.errors import NerfbakeError
from nerfbake.formats.field import torch_ngp as reader
from nerfbake.kernels.maths.elementary import fibonacci
from nerfbake.memory import memory_limit
from tests.support.nerfstudio import polynomials, random, tcnn_grid, tcnn_levels, tcnn_mlp
from tests.support.snapshots import morton
from tests.support.torch_ngp import CELLS, reference, torch_ngp, torch_ngp_file

POINTS = np.random.default_rng(0).uniform(-4, 4, (200, 3))
DIRECTIONS = fibonacci(200)


def read(root: dict[str, Any]) -> FunctionField:
    return reader.decode(memoryview(torch_ngp_file(root)))


@pytest.mark.parametrize("bound", [0.5, 2.0])
def test_values_follow_the_formula_in_the_world_of_transforms_json(bound: float) -> None:
    """The first level is dense: 17^3 nodes of its 8,192 rows, with 17 along an axis where tiny-cuda-nn has 16."""
    root = torch_ngp(bound)
    field, points = read(root), POINTS * bound
    q = 0.33 * points[:, [1, 2, 0]]
    inside = (np.abs(q) < bound).all(axis=1)
    density, features = field.density(points)
    expected, colours = reference(root, q[inside], DIRECTIONS[inside][:, [1, 2, 0]], bound)
    assert field.network.encoding.dense.tolist() == [17, 0, 0]  # type: ignore[attr-defined]
    assert 20 < inside.sum() < 200
    assert_allclose(density[inside], 0.33 * expected, rtol=1e-4)
    assert not density[~inside].any()
    assert_allclose(field.colour(features[inside], DIRECTIONS[inside]), colours, atol=1e-5)
    assert field.occupied is None


def test_a_model_with_tcnn_has_ones_as_padding(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reader, "_TCNN", reader._TCNN._replace(levels=3, log2_rows=9))
    growth = float(np.float32(np.exp(np.log(2048 * 2 / 16) / 2)))
    table = random(2 * sum(rows for *_, rows in tcnn_levels(3, 9, 16, growth)))
    first, second = random(64 * 16 + 16 * 64, seed=1), random(64 * 32 + 64 * 64 + 16 * 64, seed=2, scale=0.2)
    state = {"encoder.params": table, "sigma_net.params": first, "color_net.params": second}
    state["aabb_train"] = torch_ngp()["model"]["aabb_train"]
    field = read({"model": state}).in_trained_world()
    points = POINTS / 4
    x = (points.astype(np.float32) + np.float32(2)) / np.float32(4)
    code = tcnn_grid(table, x, levels=3, log2=9, base=16, growth=growth)
    h = tcnn_mlp(first, code, width=64, hidden=1, outputs=16)
    inputs = np.concatenate([polynomials(DIRECTIONS, signs=True), h[:, 1:]], axis=1)
    logits = tcnn_mlp(second, inputs, width=64, hidden=2, outputs=3)
    density, features = field.density(points)
    assert_allclose(density, np.exp(h[:, 0]), rtol=1e-3)
    assert_allclose(field.colour(features, DIRECTIONS), 1 / (1 + np.exp(-logits)), atol=1e-4)


def test_occupancy_is_bits_of_nested_cubes() -> None:
    """Cubes of half an edge 1, 2, 3: the last one is no power of two."""
    cells = [morton(5, 6, 7), CELLS + morton(0, 100, 1), 2 * CELLS + morton(1, 2, 127)]
    field = read(torch_ngp(3.0, occupied=cells))
    assert field.occupied is not None
    assert np.argwhere(field.occupied.cells).tolist() == [[0, 5, 6, 7], [1, 0, 100, 1], [2, 1, 2, 127]]
    assert_array_equal(field.occupied.boxes[:, 1, 0], [1, 2, 3])
    points = np.stack([(np.array([5, 6, 7]) + 0.5) / 64 - 1, (np.array([1, 2, 127]) + 0.5) * 3 / 64 - 3, [0, 0, 0]])
    assert (field.in_trained_world().density(points)[0] > 0).tolist() == [True, True, False]


def test_what_is_not_in_the_file_is_told(tmp_path: Path) -> None:
    root = torch_ngp() | {"ema": {"decay": 0.95}}
    root["model"]["bg_net.0.weight"] = np.zeros((4, 4), np.float32)
    (tmp_path / "ngp.pth").write_bytes(torch_ngp_file(root))
    notes = load(tmp_path / "ngp.pth", FunctionField).notes
    assert [note.split()[1] for note in notes] == ["scale", "background", "averaged"]


def _with(**state: Any) -> dict[str, Any]:
    root = torch_ngp()
    root["model"] |= {key.replace("__", "."): value for key, value in state.items()}
    return root


REFUSED: dict[str, tuple[dict[str, Any], str]] = {
    "a time axis": (_with(deform_net__0__weight=np.zeros(1, np.float32)), "changes with time"),
    "--tcnn of another size": (
        _with(
            encoder__params=np.zeros(1, np.float32),
            sigma_net__params=np.zeros(1, np.float32),
            color_net__params=np.zeros(1, np.float32),
        ),
        "encoder.params has shape (1,); allowed: 12,",
    ),
    "--ff": (_with(sigma_net__weights=np.zeros(1, np.float32)), "was trained with `--ff`"),
    "a flat box": (_with(aabb_train=np.zeros(6, np.float32)), "aabb_train is 0, 0, 0, 0, 0, 0"),
    "a box without end": (_with(aabb_train=np.full(6, np.inf, np.float32)), "aabb_train is inf"),
    "offsets that descend": (_with(encoder__offsets=np.array([0, 8, 4, 9], np.int32)), "are 0, 8, 4, 9"),
    "too many levels": (_with(encoder__offsets=np.arange(500, dtype=np.int32)), "shape (500,)"),
    "offsets beyond the rows": (_with(encoder__offsets=np.array([0, 8, 16, 1 << 30], np.int32)), "1,073,741,824 rows"),
    "fewer levels": (
        _with(encoder__offsets=np.array([0, torch_ngp()["model"]["encoder.offsets"][-1]])),
        "takes 6 inputs",
    ),
    "a bitfield of another size": (
        _with(density_bitfield=np.zeros(8, np.uint8)),
        "shape (8,); allowed: uint8 (524,288,)",
    ),
    "colours of other inputs": (
        _with(color_net__0__weight=np.zeros((16, 32), np.float32)),
        "color_net takes 32 inputs",
    ),
    "a number for a layer": (_with(sigma_net__0__weight=np.float32(1)), "has weights of shapes"),
    "no network": ({"model": {"encoder.offsets": np.zeros(1, np.int32)}}, "has no aabb_train"),
}


@pytest.mark.parametrize("what", REFUSED)
def test_what_does_not_fit_is_refused(what: str) -> None:
    root, said = REFUSED[what]
    data = memoryview(torch_ngp_file(root))
    with memory_limit(4 << 20), pytest.raises(NerfbakeError) as error:
        reader.decode(data)
    assert said in str(error.value)
    assert len(str(error.value)) <= 300
