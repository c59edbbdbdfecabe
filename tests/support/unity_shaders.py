"""The passes of the shaders in engines/unity: their code, and what their fragments make of a camera's rays.

Unity's own variables are constants here, and a fragment is an invocation of a compute shader: what a pass clips by
stands in `clipped`. How a fragment comes to be, and what is blended with what, is left to Unity.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake import Camera
from nerfbake.scene.octree import SparseVoxelOctree
from tests.conftest import REPOSITORY
from tests.support.csharp import PACKAGE
from tests.support.shaders import Runner

Matrix = npt.NDArray[np.float64]
SHADERS, STUBS = PACKAGE / "Shaders", REPOSITORY / "tests" / "engines" / "unity"
TWINS = ("common", "octree", "harmonics", "world")
SWAPPED = np.array([[1, 0, 0], [0, 0, 1], [0, 1, 0]])  # right-handed with z up to left-handed with y up, and back


class Pass(NamedTuple):
    """name: of its file and number; entries: functions by their stage, vertex and fragment."""

    name: str
    code: str
    entries: dict[str, str]
    keywords: list[str]


def passes() -> Iterator[Pass]:
    for shader in sorted(SHADERS.glob("*.shader")):
        for i, text in enumerate(re.findall(r"HLSLPROGRAM\n(.*?)ENDHLSL", shader.read_text(), re.DOTALL)):
            entries = dict(re.findall(r"#pragma (vertex|fragment) (\w+)", text))
            keywords = (re.findall(r"#pragma multi_compile_local (.*)", text) or [""])[0].split()
            yield Pass(f"{shader.stem}-{i}", re.sub(r"(?m)^\s*#pragma.*\n", "", text), entries, keywords)


class View(NamedTuple):
    """place: (4, 4) of the object in Unity's world, with one scale for all axes. camera: in the octree's own world.
    wall: how far away, along the middle, a flat thing is that the camera drew before. reach: where along a ray the hull
    is, in the octree's units."""

    octree: SparseVoxelOctree
    camera: Camera
    place: Matrix
    wall: float = 1e6
    orthographic: bool = False
    reach: float = 2.0

    @property
    def scale(self) -> float:
        return float(np.linalg.det(self.place) ** (1 / 3))

    def matrices(self) -> dict[str, Matrix]:
        """What Unity calls its matrices; that of clipping gives a place's depth along the middle, in Unity's units."""
        lift = self.place[:3, :3] @ SWAPPED
        view = np.eye(4)
        view[:3, :3] = (lift @ self.camera.pose[:3, :3] / self.scale).T
        view[:3, 3] = -view[:3, :3] @ self.in_unity(self.camera.pose[:3, 3])
        clip = np.diag([0.0, 0, 0, 1])
        clip[2] = -view[2]
        projection = np.diag([1.0, 1, 1, 1 if self.orthographic else 0])
        return {
            "unity_ObjectToWorld": self.place,
            "unity_WorldToObject": np.linalg.inv(self.place),
            "UNITY_MATRIX_V": view,
            "UNITY_MATRIX_P": projection,
            "UNITY_MATRIX_VP": clip,
        }

    def in_unity(self, points: Matrix) -> Matrix:
        return np.asarray(points @ (self.place[:3, :3] @ SWAPPED).T + self.place[:3, 3])

    def constants(self) -> dict[str, object]:
        octree = self.octree
        rows = np.column_stack([np.diag(1 / octree.voxel_size), -octree.origin / octree.voxel_size])
        levels = [octree.grid_level, (octree.data_dim - 1) // 3, 0, 0]
        return {
            "_OctreeSize": [*octree.size, octree.data_dim],
            "_OctreeBasis": levels,
            **{f"_ToVoxels{i}": rows[i] for i in range(3)},
            "_ProjectionParams": [1, 0, 2 * self.wall, 0],
            "_ZBufferParams": [0, 0, 0, 1 / self.wall],
            "_Cut": 1e-4,
            "_Threshold": 0.5,
        }

    def code(self, name: str) -> str:
        """A pass, and all that it includes but the twins, with Unity's variables as constants."""
        text = next(each.code for each in passes() if each.name == name)
        texts = [STUBS / "UnityCG.cginc", *(SHADERS / f"{each}.hlsl" for each in ("March", "Octree", "Caster"))]
        code = "".join(path.read_text() for path in texts) + text
        # What Unity would fill in, or bind: it comes back as a constant.
        code = re.sub(r"(?m)^\s*(#include|float\w* (_|unity_|UNITY_)\w+.*;|SamplerState|UNITY_DECLARE).*\n", "", code)
        code = re.sub(r"(?m)^#define SAMPLE_DEPTH.*\n", "", code)
        given = [f"static const float4x4 {key} = {_literal(rows)};" for key, rows in self.matrices().items()]
        given += [f"static const {_type(value)} {key} = {_literal(value)};" for key, value in self.constants().items()]
        given += ["#define SAMPLE_DEPTH_TEXTURE_PROJ(name, uv) 0.5", "#define UNITY_COLORSPACE_GAMMA 1"]
        return "\n".join([*given, "static float clipped = 1.0;", "#define clip(x) clipped = min(clipped, x)", code])


def drawn(hlsl: Runner, view: View, name: str, answer: str) -> npt.NDArray[np.float32]:
    """(n, 4), a row for each pixel of the camera: what this code returns for its `hull`, in this pass."""
    code = f"{view.code(name)}\nfloat4 answer(float4 pixel) {{ Hull hull = (Hull)0; hull.world = pixel.xyz; "
    code += f"hull.position.xy = pixel.ww; {answer} }}"
    origin, directions = view.camera.rays()
    world = view.in_unity(origin + view.reach * directions)
    pixels = np.column_stack([world, np.arange(len(world))]).astype(np.float32)
    children = view.octree.with_layout("full").node_children
    return hlsl.run(TWINS, code, pixels, {"nodeChildren": children, "nodeData": view.octree.node_data})


def _type(value: object) -> str:
    return "float4" if np.size(np.asarray(value)) == 4 else "float"


def _literal(value: object) -> str:
    numbers = [repr(float(number)) for number in np.asarray(value).ravel()]
    return {1: "{}", 4: "float4({})", 16: "float4x4({})"}[len(numbers)].format(", ".join(numbers))
