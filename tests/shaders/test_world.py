"""The world's twins in each language: points and looks of an object that an engine has moved, in its own axes."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest

from tests.support.shaders import Runner

COUNT = 100_000
# Where w is 0 a point in voxels, where it is 1 a look in the field's axes.
CODES = {
    "glsl": """
        uniform highp sampler2D rows;
        vec4 row(int i) { return texelFetch(rows, ivec2(i, 0), 0); }
        vec4 answer(vec4 p) {
            World world = World(vec4[3](row(0), row(1), row(2)), vec4[3](row(3), row(4), row(5)), AXES);
            return vec4(p.w == 0.0 ? pointInVoxels(world, p.xyz) : lookInAxes(world, p.xyz), 0);
        }""",
    "hlsl": """
        StructuredBuffer<float4> rows;
        float4 answer(float4 p) {
            World world = {{rows[0], rows[1], rows[2]}, {rows[3], rows[4], rows[5]}, AXES};
            if (p.w == 0.0) return float4(pointInVoxels(world, p.xyz), 0);
            return float4(lookInAxes(world, p.xyz), 0);
        }""",
    "wgsl": """
        @group(0) @binding(2) var<storage, read> rows: array<vec4f>;
        fn answer(p: vec4f) -> vec4f {
            let world = World(array(rows[0], rows[1], rows[2]), array(rows[3], rows[4], rows[5]), AXES);
            if p.w == 0.0 { return vec4f(pointInVoxels(world, p.xyz), 0); }
            return vec4f(lookInAxes(world, p.xyz), 0);
        }""",
}
# What each engine calls right, up and away (or towards the viewer) of what a field calls x, z and y.
ENGINES = {
    "Z_UP": np.eye(3),
    "Y_UP": np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]),
    "Y_UP_LEFT": np.array([[1.0, 0, 0], [0, 0, 1], [0, 1, 0]]),
}


def a_turn(random: np.random.Generator) -> npt.NDArray[np.float64]:
    """(3, 3) any rotation."""
    turn, _ = np.linalg.qr(random.normal(size=(3, 3)))
    return np.asarray(turn * np.linalg.det(turn))


@pytest.mark.parametrize("axes", ENGINES)
def test_what_an_engine_moved_is_found(runner: Runner, axes: str) -> None:
    random = np.random.default_rng(0)
    in_field = random.uniform(-1, 1, (COUNT, 3))  # points, then looks
    in_field[COUNT // 2 :] /= np.linalg.norm(in_field[COUNT // 2 :], axis=1, keepdims=True)
    is_look = np.arange(COUNT) >= COUNT // 2
    # The engine's object, of the field's own axes in its own, was turned, made larger and moved.
    matrix, moved = 1.5 * a_turn(random), np.array([3.0, -2.0, 0.5])
    in_world = in_field @ ENGINES[axes].T @ matrix.T + np.where(is_look[:, None], 0, moved)
    given = in_world.astype(np.float32)
    voxel_size, origin = np.array([0.1, 0.05, 0.2]), np.array([-1.0, -1.5, -2.0])
    to_object = np.linalg.inv(matrix)
    rows = np.concatenate(
        [
            np.column_stack([to_object, -to_object @ moved]),
            np.column_stack([np.diag(1 / voxel_size), -origin / voxel_size]),
        ]
    ).astype(np.float32)
    points = np.column_stack([given, is_look]).astype(np.float32)
    found = runner.run(("world",), CODES[runner.language].replace("AXES", axes), points, {"rows": rows})
    wanted = np.where(is_look[:, None], in_field, (in_field - origin) / voxel_size)
    extent = np.where(is_look[:, None], 1, 2 / voxel_size)
    assert np.abs((found[:, :3] - wanted) / extent).max() < 1e-6


def test_left_handed_is_the_mirror_of_right_handed() -> None:
    assert [np.linalg.det(turn) for turn in ENGINES.values()] == [1, 1, -1]
