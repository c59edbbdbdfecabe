"""K-Planes: formulas, the density last with -1, its settings, torch's own interpolation, and what is refused."""

from __future__ import annotations

import json
import subprocess
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from nerfbake import FunctionField
from nerfbake.errors import NerfbakeError
from nerfbake.formats.field import nerfstudio as reader
from nerfbake.formats.field.run_files import Run
from nerfbake.kernels.maths.elementary import fibonacci
from nerfbake.memory import memory_limit
from tests.support.kplanes import BOX, CHANNELS, kplanes, kplanes_file, reference
from tests.support.nerfstudio import contracted

POINTS = np.random.default_rng(0).uniform(-2.5, 2.5, (120, 3))
DIRECTIONS = fibonacci(120)


def read(root: dict[str, Any], **settings: Any) -> FunctionField:
    return reader.field_of(memoryview(kplanes_file(root)), Run(settings))


@pytest.mark.parametrize("concatenated", [True, False])
@pytest.mark.parametrize("appearance", [0, 5])
def test_values_follow_the_formula(concatenated: bool, appearance: int) -> None:
    root = kplanes(concatenated=concatenated, appearance=appearance)
    field = read(root, concat_features_across_scales=concatenated)
    x = (POINTS - BOX[0]) / (BOX[1] - BOX[0]) * 2 - 1
    expected, colours = reference(root, x, DIRECTIONS, concatenated=concatenated)
    inside = (np.abs(x) < 1).all(axis=1)
    density, features = field.density(POINTS)
    assert 10 < inside.sum() < 110
    assert_allclose(density[inside], expected[inside], rtol=2e-5)
    assert not density[~inside].any()
    assert_allclose(field.colour(features, DIRECTIONS)[inside], colours[inside], atol=5e-6)
    assert (field.background, field.near, field.far) == ((1.0, 1.0, 1.0), 2.0, 6.0)
    assert any("faces" in note for note in field.notes)
    assert_array_equal(field.box, BOX)
    assert str(field.network).startswith(f"planes of 4x3x5, 8x6x10 nodes x {CHANNELS}, ")
    assert field.problems() == []


def test_a_contracted_scene_is_all_of_space() -> None:
    root = kplanes()
    field = read(root, is_contracted=True, near_plane=0.1)
    x = contracted(POINTS) * 2 - 1
    assert_allclose(field.density(POINTS)[0], reference(root, x, DIRECTIONS)[0], rtol=2e-5)
    assert (field.near, field.notes) == (0.1, ())


REFUSED: dict[str, tuple[dict[str, Any], str]] = {
    "time": (kplanes(axes=4), "is a scene that changes with time: it has six planes"),
    "a linear decoder": (
        {"pipeline": kplanes()["pipeline"] | {"_model.field.color_basis.params": np.zeros(1, np.float32)}},
        "linear_decoder: true",
    ),
    "planes of other sizes": (
        {"pipeline": kplanes()["pipeline"] | {"_model.field.grids.0.plane_coefs.2": np.zeros((3, 5, 4), np.float32)}},
        "plane_coefs.2 has shape (3, 5, 4); allowed: (3, 5, 3)",
    ),
    "planes that are none": (
        {"pipeline": kplanes()["pipeline"] | {"_model.field.grids.1.plane_coefs.0": np.zeros(9, np.float32)}},
        "plane_coefs.0 has shape (9,)",
    ),
    "a plane too few": (
        {"pipeline": {k: v for k, v in kplanes()["pipeline"].items() if "0.plane_coefs.1" not in k}},
        "has no field.grids.0.plane_coefs.1",
    ),
    "networks of other sizes": (
        {"pipeline": kplanes()["pipeline"] | {"_model.field.sigma_net.params": np.zeros(99, np.float32)}},
        "field.sigma_net.params has 99 numbers",
    ),
}


@pytest.mark.parametrize("what", REFUSED)
def test_what_does_not_fit_is_refused(what: str) -> None:
    root, said = REFUSED[what]
    data = memoryview(kplanes_file(root))
    with memory_limit(1 << 20), pytest.raises(NerfbakeError) as error:
        reader.decode(data)
    assert said in str(error.value)
    assert len(str(error.value)) <= 300


# -- torch itself ----------------------------------------------------------------------------------------------
_ASKS = """
import json, sys, torch
import torch.nn.functional as F
state, x = torch.load(sys.argv[1])["pipeline"], torch.tensor(json.load(sys.stdin))
found = []
for s in range(2):
    product = 1.0
    for c, pair in enumerate([(0, 1), (0, 2), (1, 2)]):
        plane = state[f"_model.field.grids.{s}.plane_coefs.{c}"].unsqueeze(0)
        at = x[:, pair].view(1, 1, -1, 2)
        value = F.grid_sample(plane, at, align_corners=True, padding_mode="border")
        product = product * value.view(plane.shape[1], -1).T
    found.append(product)
print(json.dumps(torch.cat(found, dim=1).tolist()))
"""


def test_torch_interpolates_the_same_features(torch: str, tmp_path: Any) -> None:
    file = tmp_path / "step.ckpt"
    file.write_bytes(kplanes_file())
    x = np.random.default_rng(1).uniform(-1, 1, (80, 3)).astype(np.float32)
    x[:8] = [[a, b, c] for a in (-1, 1) for b in (-1, 1) for c in (-1, 1)]
    asked = subprocess.run(
        [torch, "-c", _ASKS, str(file)], input=json.dumps(x.tolist()).encode(), capture_output=True, check=True
    )
    encoding = read(kplanes()).network.encoding  # type: ignore[attr-defined]
    assert_allclose(encoding((x + 1) / 2).T, json.loads(asked.stdout), atol=1e-5)
