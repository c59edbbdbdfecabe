"""The VDB index's twins in each language, fed with the arrays of a .vdb.npz as it was written."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import pytest

from nerfbake import IndexGrid, Volume, save
from nerfbake.scene.vdb_voxels import topology_of
from tests.support.shaders import Runner

COUNT, CHANNELS = 120_000, 7
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
    points: npt.NDArray[np.float32]
    bound: dict[str, Any]


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    """Voxels in clouds about corners of root tiles, of signs of all kinds; every value another."""
    random = np.random.default_rng(0)
    middles = np.array([[0, 0, 0], [4096, -4096, 0], [-8192, 4100, 130], [9000, 9000, -9000]])
    cloud = np.concatenate([middle + random.normal(0, 6, (1500, 3)) for middle in middles])
    topology, _ = topology_of(np.unique(np.floor(cloud).astype(np.int64), axis=0))
    grid = IndexGrid("index", topology, random.random((topology.m + 1, CHANNELS), np.float32))
    path = tmp_path_factory.mktemp("vdb") / "index.vdb.npz"
    save(path, Volume((grid,), np.eye(4)[:3]))
    return Scene(grid, places(topology.coords), bound_of(path))


def bound_of(path: Path) -> dict[str, Any]:
    with np.load(path) as npz:
        origin, table = npz["tree_0_root_origin"], npz["grid_0_table"]
        levels = {name: (npz[f"tree_0_{name}_mask"], npz[f"tree_0_{name}_rank"]) for name in ("upper", "lower", "leaf")}
    pairs = {name: np.stack(each, axis=-1).reshape(-1, 2) for name, each in levels.items()}
    sizes = np.array([len(origin), table.shape[1]], np.int32)
    return {"sizes": sizes, "rootOrigin": origin.ravel(), **pairs, "table": table.ravel()}


def places(coords: npt.NDArray[Any]) -> npt.NDArray[np.float32]:
    """(COUNT, 4) about the voxels, on the borders between them and a hair beside, in tiles that are not there, and
    very far away."""
    random = np.random.default_rng(1)
    points = np.zeros((COUNT, 4), np.float32)
    points[:, :3] = random.choice(coords, COUNT) + random.uniform(-2, 2, (COUNT, 3))
    points[COUNT // 2 : COUNT * 2 // 3, :3] *= 3
    halves = points[: COUNT // 3, :3]
    halves[:] = np.round(2 * halves) / 2
    halves[::3] = np.nextafter(halves[::3], np.float32(np.inf))
    halves[1::3] = np.nextafter(halves[1::3], np.float32(-np.inf))
    halves[abs(halves) < 1e-30] *= 1e30  # processors may take the smallest numbers of all for 0
    points[:4, :3] = [[1e30, 0, 0], [0, -3e9, 0], [0, 0, np.inf], [-0.0, -0.5, 0.5]]
    points[:, 3] = np.arange(COUNT) % CHANNELS
    return points


def test_every_voxel_is_what_the_program_finds(runner: Runner, scene: Scene) -> None:
    found = runner.run(("common", "vdb_index"), CODES[runner.language], scene.points, scene.bound)
    at, k = scene.points[:, :3].astype(np.float64), scene.points[:, 3].astype(int)
    nearest, trilinear = (scene.grid.sample(at, lookup=how)[np.arange(COUNT), k] for how in ("nearest", "trilinear"))
    assert np.flatnonzero(found[:, 1] != nearest).tolist() == []
    np.testing.assert_allclose(found[:, 2], trilinear, atol=1e-5)
    assert 0.1 < (found[:, 0] == 0).mean() < 0.9
