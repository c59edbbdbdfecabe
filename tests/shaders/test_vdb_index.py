"""The VDB index's twins in each language, fed with the arrays of a .vdb.npz as it was written."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

from nerfbake import IndexGrid, Volume, save
from nerfbake.scene.vdb_topology import topology_of
from tests.support.places import COUNT, around, clouds
from tests.support.shaders import Points, Runner

CHANNELS = 7
# Of each point the row, number k of it, and the same between the centres of voxels, for k = w.
CODES = {
    "glsl": """
        uniform isampler2D sizes;
        vec4 answer(vec4 p) {
            VdbIndex index = VdbIndex(fetchInt(sizes, 0), fetchInt(sizes, 1));
            int k = int(p.w), row = vdbNearest(index, p.xyz);
            return vec4(row, vdbValue(index, row, k), vdbTrilinear(index, vdbCorners(index, p.xyz), k), 0);
        }""",
    "hlsl": """
        StructuredBuffer<int> sizes;
        float4 answer(float4 p) {
            VdbIndex index = {sizes[0], sizes[1]};
            int k = int(p.w), row = vdbNearest(index, p.xyz);
            return float4(row, vdbValue(index, row, k), vdbTrilinear(index, vdbCorners(index, p.xyz), k), 0);
        }""",
    "wgsl": """
        @group(0) @binding(2) var<storage, read> sizes: array<i32>;
        fn answer(p: vec4f) -> vec4f {
            let index = VdbIndex(sizes[0], sizes[1]);
            let k = i32(p.w);
            let row = vdbNearest(index, p.xyz);
            return vec4f(f32(row), vdbValue(index, row, k), vdbTrilinear(index, vdbCorners(index, p.xyz), k), 0);
        }""",
}


class Scene(NamedTuple):
    grid: IndexGrid
    points: Points
    bound: dict[str, Any]


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    """Every value another."""
    topology, _ = topology_of(clouds())
    table = np.random.default_rng(0).random((topology.m + 1, CHANNELS), np.float32)
    grid = IndexGrid("index", topology, table)
    path = tmp_path_factory.mktemp("vdb") / "index.vdb.npz"
    save(path, Volume((grid,), np.eye(4)[:3]))
    return Scene(grid, around(topology.coords, CHANNELS), bound_of(path))


def bound_of(path: Path) -> dict[str, Any]:
    with np.load(path) as npz:
        origin, table = npz["tree_0_root_origin"], npz["grid_0_table"]
        levels = {name: (npz[f"tree_0_{name}_mask"], npz[f"tree_0_{name}_rank"]) for name in ("upper", "lower", "leaf")}
    pairs = {name: np.stack(each, axis=-1).reshape(-1, 2) for name, each in levels.items()}
    sizes = np.array([len(origin), table.shape[1]], np.int32)
    return {"sizes": sizes, "rootOrigin": origin.ravel(), **pairs, "table": table.ravel()}


def test_every_voxel_is_what_the_program_finds(runner: Runner, scene: Scene) -> None:
    found = runner.run(("common", "vdb_index"), CODES[runner.language], scene.points, scene.bound)
    at, k = scene.points[:, :3].astype(np.float64), scene.points[:, 3].astype(int)
    nearest, trilinear = (scene.grid.sample(at, lookup=how)[np.arange(COUNT), k] for how in ("nearest", "trilinear"))
    assert np.flatnonzero(found[:, 1] != nearest).tolist() == []
    np.testing.assert_allclose(found[:, 2], trilinear, atol=1e-5)
    assert 0.1 < (found[:, 0] == 0).mean() < 0.9
