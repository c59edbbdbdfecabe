"""The octree's twins in each language: every voxel is what the program's own lookup finds."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import pytest

from nerfbake import SparseVoxelOctree, build_octree, sample_n3tree
from tests.support.places import COUNT, in_grid
from tests.support.shaders import Points, Runner

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
    points: Points
    nearest: npt.NDArray[np.float32]
    trilinear: npt.NDArray[np.float32]


@pytest.fixture(scope="module")
def scene() -> Scene:
    """An octree over no cube, compact, with leaves of several sizes, and every value another."""
    octree = build_octree(sample_n3tree(resolution=32), resolution=(24, 32, 17)).with_layout("compact")
    values = np.random.default_rng(0).random(octree.node_data.shape, np.float32)
    octree = SparseVoxelOctree(octree.size, octree.node_children, values, octree.data_format)
    points = in_grid(octree.size, octree.data_dim)
    at = points[:, :3].astype(np.float64)
    found = [
        octree.sample(at, lookup=lookup)[np.arange(COUNT), points[:, 3].astype(int)]
        for lookup in ("nearest", "trilinear")
    ]
    return Scene(octree, points, found[0], found[1])


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
