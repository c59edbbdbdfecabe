"""The shader twins in each language find in the frozen files what their JSON says."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from tests.conformance.case import HOME
from tests.shaders import test_harmonics, test_octree, test_vdb_index
from tests.support.shaders import Points, Runner

OCTREES = sorted(HOME.glob("octree/*.expected.json"))
INDICES = sorted(HOME.glob("volume/index*.vdb.npz"))


def every_number(places: npt.NDArray[np.float64], D: int) -> Points:
    """Each place once for each of the D values there."""
    return np.column_stack([np.repeat(places, D, axis=0), np.tile(np.arange(D), len(places))]).astype(np.float32)


def require_same(found: Points, lookups: list[dict[str, Any]]) -> None:
    for column, name in ((1, "nearest"), (2, "trilinear")):
        wanted = np.array([each[name] for each in lookups], np.float32).ravel()
        np.testing.assert_allclose(found[:, column], wanted, rtol=0 if column == 1 else 1e-5, atol=1e-5 * (column == 2))


@pytest.mark.parametrize("document", OCTREES, ids=lambda path: path.name.split(".")[0])
def test_an_octree_is_what_its_json_says(runner: Runner, document: Path) -> None:
    told = json.loads(document.read_text())
    lookups, D = told["lookups"], told["data_dim"]
    data = np.array(told["node_data"], np.float32)
    children = np.zeros((len(data), 8), np.int32)
    children[: len(told["node_children"])] = told["node_children"]
    places = (np.array([each["point"] for each in lookups]) - told["origin"]) / told["voxel_size"]
    sizes = np.array([*told["size"], D, (max(told["size"]) - 1).bit_length()], np.int32)
    bound = {"sizes": sizes, "nodeChildren": children.ravel(), "nodeData": data.ravel()}
    code = test_octree.CODES[runner.language]
    require_same(runner.run(("common", "octree"), code, every_number(places, D), bound), lookups)
    if told["data_format"].startswith("SH") and "colour" in lookups[0]:
        require_colours(runner, lookups, (D - 1) // 3)


def require_colours(runner: Runner, lookups: list[dict[str, Any]], B: int) -> None:
    looks = every_number(np.array([each["direction"] for each in lookups]), B)
    looks[:, 3] += 25 * round(B**0.5)
    functions = runner.run(("harmonics",), test_harmonics.CODES[runner.language], looks, {})[:, 0].reshape(-1, B)
    for basis, each in zip(functions, lookups, strict=True):
        if each["colour"] is not None:
            sums = np.array(each["nearest"][:-1]).reshape(3, B) @ basis
            np.testing.assert_allclose(1 / (1 + np.exp(-sums)), each["colour"], atol=1e-5)


@pytest.mark.parametrize("path", INDICES, ids=lambda path: path.name.split(".")[0])
def test_an_index_is_what_its_json_says(runner: Runner, path: Path) -> None:
    told = json.loads((HOME / "volume" / path.name.replace(".vdb.npz", ".expected.json")).read_text())
    (grid,) = told["grids"]
    points = every_number(np.array([each["voxel"] for each in grid["lookups"]]), len(grid["background"]))
    bound = test_vdb_index.bound_of(path)
    bound["table"] = bound["table"].astype(np.float32)
    code = test_vdb_index.CODES[runner.language]
    require_same(runner.run(("common", "vdb_index"), code, points, bound), grid["lookups"])
