"""The octree's twins in each language: every voxel is what the program's own lookup finds."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import pytest

from nerfbake import SparseVoxelOctree, build_octree, sample_n3tree
from tests.support.shaders import Runner

COUNT = 120_000
# Of each point the node, number k of its values, and the same between the centres of voxels, for k = w.
CODES = {
    "glsl": """
        uniform isampler2D sizes;
        int size(int i) { return fetchInt(sizes, i); }
        vec4 answer(vec4 p) {
            SparseVoxelOctree octree = SparseVoxelOctree(size(0), size(1), size(2), size(3), size(4));
            int k = int(p.w), row = octreeNearest(octree, p.xyz);
            float between = octreeTrilinear(octree, octreeCorners(octree, p.xyz), k);
            return vec4(row, octreeValue(octree, row, k), between, 0);
        }""",
    "hlsl": """
        StructuredBuffer<int> sizes;
        float4 answer(float4 p) {
            SparseVoxelOctree octree = {sizes[0], sizes[1], sizes[2], sizes[3], sizes[4]};
            int k = int(p.w), row = octreeNearest(octree, p.xyz);
            float between = octreeTrilinear(octree, octreeCorners(octree, p.xyz), k);
            return float4(row, octreeValue(octree, row, k), between, 0);
        }""",
    "wgsl": """
        @group(0) @binding(2) var<storage, read> sizes: array<i32>;
        fn answer(p: vec4f) -> vec4f {
            let octree = SparseVoxelOctree(sizes[0], sizes[1], sizes[2], sizes[3], sizes[4]);
            let k = i32(p.w);
            let row = octreeNearest(octree, p.xyz);
            let between = octreeTrilinear(octree, octreeCorners(octree, p.xyz), k);
            return vec4f(f32(row), octreeValue(octree, row, k), between, 0);
        }""",
}


class Scene(NamedTuple):
    octree: SparseVoxelOctree
    points: npt.NDArray[np.float32]
    nearest: npt.NDArray[np.float32]
    trilinear: npt.NDArray[np.float32]


@pytest.fixture(scope="module")
def scene() -> Scene:
    """An octree over no cube, compact, with leaves of several sizes, and every value another."""
    octree = build_octree(sample_n3tree(resolution=32), resolution=(24, 32, 17)).with_layout("compact")
    values = np.random.default_rng(0).random(octree.node_data.shape, np.float32)
    octree = SparseVoxelOctree(octree.size, octree.node_children, values, octree.data_format)
    points = places(octree.size)
    k = np.arange(COUNT) % octree.data_dim
    at = points[:, :3].astype(np.float64)
    found = [octree.sample(at, lookup=lookup)[np.arange(COUNT), k] for lookup in ("nearest", "trilinear")]
    points[:, 3] = k
    return Scene(octree, points, found[0], found[1])


def places(size: tuple[int, ...]) -> npt.NDArray[np.float32]:
    """Anywhere in and around the grid, on the borders of voxels, a hair beside them, and very far away."""
    random = np.random.default_rng(1)
    points = np.zeros((COUNT, 4), np.float32)
    points[:, :3] = random.uniform(-3, np.array(size) + 3, (COUNT, 3))
    whole = points[: COUNT // 3, :3]
    whole[:] = np.floor(2 * whole) / 2
    whole[::3] = np.nextafter(whole[::3], np.float32(np.inf))
    whole[1::3] = np.nextafter(whole[1::3], np.float32(-np.inf))
    whole[abs(whole) < 1e-30] *= 1e30  # processors may take the smallest numbers of all for 0
    points[:8, :3] = [
        [1e30, 0, 0],
        [-1e30, 1, 1],
        [0, 3e9, 0],
        [0, -5e9, 0],
        [0, 0, np.inf],
        [-np.inf, 0, 0],
        [-0.0] * 3,
        size,
    ]
    return points


def test_every_voxel_is_what_the_program_finds(runner: Runner, scene: Scene) -> None:
    octree = scene.octree
    children = np.zeros((octree.n, 8), np.int32)
    children[: octree.c] = octree.node_children
    children[1::2][children[1::2] == 0] = -1
    sizes = np.array([*octree.size, octree.data_dim, octree.grid_level], np.int32)
    bound: dict[str, Any] = {"sizes": sizes, "nodeChildren": children.ravel(), "nodeData": octree.node_data.ravel()}
    found = runner.run(("common", "octree"), CODES[runner.language], scene.points, bound)
    assert np.flatnonzero(found[:, 1] != scene.nearest).tolist() == []
    np.testing.assert_allclose(found[:, 2], scene.trilinear, atol=1e-5)
    assert (found[:, 0] < 0).mean() > 0.1
