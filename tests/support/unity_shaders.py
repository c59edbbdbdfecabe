"""Run the shader passes of engines/unity for the rays of a camera.

Unity's variables are constants here, and each fragment is an invocation of a compute shader. `clipped` contains the
value that a pass clips by. Rasterisation and blending, which Unity does, are not tested.
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
SWAPPED = np.array([[1, 0, 0], [0, 0, 1], [0, 1, 0]])  # between right-handed with z up and left-handed with y up


class Pass(NamedTuple):
    """A shader pass.

    name     file name and number
    entries  entry functions by stage: vertex, fragment
    """

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
    """A view of an octree in Unity.

    camera  a camera in the octree's world coordinates
    place   (4, 4) from object to Unity world coordinates, with uniform scale
    wall    depth of a flat object that the camera has already drawn, along its axis
    reach   distance of the hull along each ray, in the octree's units
    """

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
        """Unity's matrices by name. The clip matrix returns the depth along the camera axis, in Unity's units."""
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
        """The code of a pass with all includes except the shared HLSL files, and Unity's variables as constants."""
        text = next(each.code for each in passes() if each.name == name)
        texts = [STUBS / "UnityCG.cginc", *(SHADERS / f"{each}.hlsl" for each in ("March", "Octree", "Caster"))]
        code = "".join(path.read_text() for path in texts) + text
        # Remove the variables that Unity sets or binds. They are added below as constants.
        code = re.sub(r"(?m)^\s*(#include|float\w* (_|unity_|UNITY_)\w+.*;|SamplerState|UNITY_DECLARE).*\n", "", code)
        code = re.sub(r"(?m)^#define SAMPLE_DEPTH.*\n", "", code)
        given = [f"static const float4x4 {key} = {_literal(rows)};" for key, rows in self.matrices().items()]
        given += [f"static const {_type(value)} {key} = {_literal(value)};" for key, value in self.constants().items()]
        given += ["#define SAMPLE_DEPTH_TEXTURE_PROJ(name, uv) 0.5", "#define UNITY_COLORSPACE_GAMMA 1"]
        return "\n".join([*given, "static float clipped = 1.0;", "#define clip(x) clipped = min(clipped, x)", code])


def drawn(hlsl: Runner, view: View, name: str, answer: str) -> npt.NDArray[np.float32]:
    """(n, 4) the values that the code `answer` returns for the `hull` of each pixel of the camera, in this pass."""
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
