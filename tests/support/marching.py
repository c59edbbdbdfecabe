"""Run the ray marcher in GLSL, HLSL and WGSL: entry code for each language, and the buffers that it reads."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from nerfbake import PageField
from tests.support.shaders import Points, Runner

AXES = ("Z_UP", "Y_UP", "Y_UP_LEFT")
# March a ray in direction xyz up to distance w. Returns its colour over white and its depth, or the cutout colour.
CODES = {
    "glsl": """
        uniform sampler2D rows;
        uniform sampler2D numbers;
        vec4 row(int i) { return fetchFloat4(rows, i); }
        float n(int i) { return fetchFloat(numbers, i); }
        vec4 answer(vec4 p) {
            World world = World(vec4[3](row(0), row(1), row(2)), vec4[3](row(3), row(4), row(5)), int(n(0)));
            vec3 low = vec3(n(4), n(5), n(6)), high = vec3(n(7), n(8), n(9));
            Field field = Field(ivec3(n(1), n(2), n(3)), low, high, int(n(10)), n(11));
            Harmonics basis = harmonics(lookInAxes(world, p.xyz), int(n(15)));
            vec3 origin = pointInVoxels(world, vec3(n(12), n(13), n(14)));
            Marched found = march(field, origin, stepInVoxels(world, p.xyz), basis, p.w, n(16));
            if (n(17) > 0.0) return cutout(found, n(16));
            return vec4(found.colour + found.transmittance, found.depth);
        }""",
    "hlsl": """
        StructuredBuffer<float4> rows;
        StructuredBuffer<float> numbers;
        float n(int i) { return numbers[i]; }
        float4 answer(float4 p) {
            World world = {{rows[0], rows[1], rows[2]}, {rows[3], rows[4], rows[5]}, int(n(0))};
            Field field = {
                int3(n(1), n(2), n(3)), float3(n(4), n(5), n(6)), float3(n(7), n(8), n(9)), int(n(10)), n(11)
            };
            Harmonics basis = harmonics(lookInAxes(world, p.xyz), int(n(15)));
            float3 origin = pointInVoxels(world, float3(n(12), n(13), n(14)));
            Marched found = march(field, origin, stepInVoxels(world, p.xyz), basis, p.w, n(16));
            if (n(17) > 0.0) return cutout(found, n(16));
            return float4(found.colour + found.transmittance, found.depth);
        }""",
    "wgsl": """
        @group(0) @binding(2) var<storage, read> rows: array<vec4f>;
        @group(0) @binding(3) var<storage, read> numbers: array<f32>;
        fn n(i: i32) -> f32 { return numbers[i]; }
        fn answer(p: vec4f) -> vec4f {
            let world = World(array(rows[0], rows[1], rows[2]), array(rows[3], rows[4], rows[5]), i32(n(0)));
            let low = vec3f(n(4), n(5), n(6));
            let high = vec3f(n(7), n(8), n(9));
            let field = Field(vec3i(vec3f(n(1), n(2), n(3))), low, high, i32(n(10)), n(11));
            let basis = harmonics(lookInAxes(world, p.xyz), i32(n(15)));
            let origin = pointInVoxels(world, vec3f(n(12), n(13), n(14)));
            let found = march(field, origin, stepInVoxels(world, p.xyz), basis, p.w, n(16));
            if n(17) > 0.0 { return cutout(found, n(16)); }
            return vec4f(found.colour + found.transmittance, found.depth);
        }""",
}


def marched(
    runner: Runner,
    field: PageField,
    eye: npt.NDArray[np.float64],
    looks: npt.NDArray[np.float64],
    *,
    stop: Any = 1e30,
    cut: float = 1e-4,
    cutout: bool = False,
    axes: str = "Z_UP",
    to_object: npt.NDArray[np.float64] | None = None,
) -> Points:
    """(n, 4) the results of rays from eye (3,) in the directions looks (n, 3), unit vectors, in engine coordinates.

    to_object: (3, 4) from engine to object coordinates; None: the identity.
    """
    points = np.empty((len(looks), 4), np.float32)
    points[:, :3], points[:, 3] = looks, stop
    rows = np.concatenate([np.eye(4)[:3] if to_object is None else to_object, field.place])
    T = field.texels.shape[1]
    facts = [AXES.index(axes), *field.top.shape, *field.box.ravel(), T, field.density_unit]
    numbers = [*facts, *eye, field.basis.size, cut, cutout]
    bound: dict[str, Any] = {
        "top": field.top.ravel(),
        "blocks": field.blocks,
        "texels": field.texels.reshape(-1, 4).astype(np.float32),
        "rows": rows.astype(np.float32),
        "numbers": np.array(numbers, np.float32),
    }
    parts = ("common", "harmonics", "world", "march")
    return runner.run(parts, CODES[runner.language], points, bound)
