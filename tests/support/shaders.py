"""Run the GLSL, HLSL and WGSL shaders without a window: evaluate one function for many points at once.

A runner combines the shader files, the code of a test, and a `main`. The code of the test defines answer(point), which
maps a vec4 to a vec4. Buffers and pictures are bound by their names in the shader files or in the code of the test.
"""

from __future__ import annotations

import re
import shutil
import subprocess
from collections.abc import Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np
import numpy.typing as npt
import pytest

from nerfbake.jobs.shaders import shader_text

HOME = files("nerfbake") / "shaders"
LANGUAGES = ("glsl", "hlsl", "wgsl")
VERSIONS = ("300 es", "330")  # GLSL versions
Points = npt.NDArray[np.float32]  # (n, 4)
_WIDTH = 512  # texels per line of a GLSL buffer
_GROUP = 64  # points per workgroup of a compute shader
_DEBIAN = "Debian: glslang-tools, mesa-vulkan-drivers, libegl1, libgl1-mesa-dri"


class Picture(NamedTuple):
    """An image (H, W, 4) float32. smooth: bilinear filtering; else nearest texel. Coordinates clamp to the edges."""

    texels: npt.NDArray[np.float32]
    smooth: bool = False


Bound = Mapping[str, npt.NDArray[Any] | Picture]


class Runner(Protocol):
    """Runs shaders of one language.

    compile() compiles the files with these names and raises if they are invalid. run() evaluates answer() for points
    (n, 4) and returns the results, (n, 4) float32.
    """

    language: str

    def compile(self, parts: Sequence[str]) -> None: ...

    def run(self, parts: Sequence[str], code: str, points: Points, bound: Bound) -> Points: ...


def text_of(language: str, parts: Sequence[str]) -> str:
    return "\n".join(shader_text(f"{language}/{part}.{language}") for part in parts)


def runner_of(language: str, folder: Path) -> Runner:
    return Glsl() if language == "glsl" else Wgsl() if language == "wgsl" else Hlsl(folder)


class Glsl:
    """Runs GLSL in both versions on Mesa's llvmpipe, with one pixel per point."""

    language = "glsl"

    def __init__(self) -> None:
        moderngl = pytest.importorskip("moderngl")
        try:
            self.context: Any = moderngl.create_standalone_context(backend="egl", require=330)
        except Exception as error:
            pytest.skip(f"no OpenGL here ({_DEBIAN}): {error}")
        self.context.gc_mode = "auto"
        self.filters = moderngl.NEAREST, moderngl.LINEAR

    def compile(self, parts: Sequence[str]) -> None:
        for version in VERSIONS:
            main = "layout(location = 0) out highp vec4 result; void main() { result = vec4(1); }"
            self._program(version, f"{text_of('glsl', parts)}\n{main}")

    def run(self, parts: Sequence[str], code: str, points: Points, bound: Bound) -> Points:
        source = f"""{text_of("glsl", parts)}
            {code}
            uniform highp sampler2D points;
            layout(location = 0) out highp vec4 result;
            void main() {{ result = answer(texelFetch(points, ivec2(gl_FragCoord.xy), 0)); }}"""
        found = [self._run(version, source, {"points": points, **bound}) for version in VERSIONS]
        np.testing.assert_array_equal(found[0], found[1])
        return found[0][: len(points)]

    def _run(self, version: str, source: str, bound: Bound) -> Points:
        program = self._program(version, source)
        textures = [self._texture(array) for array in bound.values()]
        for unit, (name, texture) in enumerate(zip(bound, textures, strict=True)):
            if name in program:
                texture.use(unit)
                program[name].value = unit
        size = textures[0].size
        target = self.context.framebuffer([self.context.texture(size, 4, dtype="f4")])
        target.use()
        corners = self.context.buffer(np.array([-1, -1, 3, -1, -1, 3], np.float32).tobytes())
        self.context.vertex_array(program, [(corners, "2f", "p")]).render()
        return np.frombuffer(target.read(components=4, dtype="f4"), np.float32).reshape(-1, 4)

    def _program(self, version: str, source: str) -> Any:
        vertex = f"#version {version}\nin vec2 p; void main() {{ gl_Position = vec4(p, 0, 1); }}"
        return self.context.program(vertex_shader=vertex, fragment_shader=f"#version {version}\n{source}")

    def _texture(self, array: npt.NDArray[Any] | Picture) -> Any:
        texels = array.texels if isinstance(array, Picture) else in_lines(array)
        dtype = {"f": "f4", "i": "i4", "u": "u4"}[texels.dtype.kind]
        texture = self.context.texture(texels.shape[1::-1], texels.shape[2], texels.tobytes(), dtype=dtype)
        texture.filter = (self.filters[isinstance(array, Picture) and array.smooth],) * 2
        texture.repeat_x = texture.repeat_y = False
        return texture


def in_lines(array: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Convert a buffer (n,) or (n, c) to an image, padded to full lines."""
    flat = array.reshape(len(array), -1)
    lines = np.zeros((-(-len(flat) // _WIDTH) * _WIDTH, flat.shape[1]), flat.dtype)
    lines[: len(flat)] = flat
    return lines.reshape(-1, _WIDTH, flat.shape[1])


class Wgsl:
    """Runs WGSL as a compute shader with wgpu on Mesa's lavapipe."""

    language = "wgsl"

    def __init__(self) -> None:
        self.wgpu: Any = pytest.importorskip("wgpu")
        adapters = [adapter for adapter in self.wgpu.gpu.enumerate_adapters_sync() if "Vulkan" in str(adapter.info)]
        if not adapters:
            pytest.skip(f"no Vulkan here ({_DEBIAN})")
        self.device = adapters[0].request_device_sync(required_features=["float32-filterable"])

    def compile(self, parts: Sequence[str]) -> None:
        self.device.create_shader_module(code=text_of("wgsl", parts))

    def run(self, parts: Sequence[str], code: str, points: Points, bound: Bound) -> Points:
        source = f"""{text_of("wgsl", parts)}
            {code}
            @group(0) @binding(0) var<storage, read> points: array<vec4f>;
            @group(0) @binding(1) var<storage, read_write> result: array<vec4f>;
            @compute @workgroup_size({_GROUP}) fn main(@builtin(global_invocation_id) id: vec3u) {{
                if id.x < arrayLength(&points) {{ result[id.x] = answer(points[id.x]); }}
            }}"""
        places = re.findall(r"@group\((\d)\) @binding\((\d+)\) var\S* *(?:read\w*> )?(\w+):", source)
        return self.dispatch(source, {name: (int(g), int(b)) for g, b, name in places}, points, bound)

    def dispatch(self, code: str | bytes, places: dict[str, tuple[int, int]], points: Points, bound: Bound) -> Points:
        """Run a compute shader. places: group and binding of each name."""
        usage, device = self.wgpu.BufferUsage, self.device
        result = device.create_buffer(size=points.nbytes, usage=usage.STORAGE | usage.COPY_SRC)
        held: dict[str, Any] = {"points": points, "nearest": "nearest", "smoothly": "linear", **bound, "result": result}
        groups: dict[int, list[tuple[Any, Any]]] = {
            group: [] for group in range(1 + max(g for g, _ in places.values()))
        }
        for name, (group, binding) in places.items():
            layout, resource = self._resource(held[name])
            layout |= {"binding": binding, "visibility": self.wgpu.ShaderStage.COMPUTE}
            groups[group].append((layout, {"binding": binding, "resource": resource}))
        layouts = [device.create_bind_group_layout(entries=[entry for entry, _ in each]) for each in groups.values()]
        pipeline = device.create_compute_pipeline(
            layout=device.create_pipeline_layout(bind_group_layouts=layouts),
            compute={"module": device.create_shader_module(code=code), "entry_point": "main"},
        )
        encoder = device.create_command_encoder()
        work = encoder.begin_compute_pass()
        work.set_pipeline(pipeline)
        for group, entries in groups.items():
            work.set_bind_group(
                group, device.create_bind_group(layout=layouts[group], entries=[entry for _, entry in entries])
            )
        work.dispatch_workgroups(-(-len(points) // _GROUP))
        work.end()
        device.queue.submit([encoder.finish()])
        return np.frombuffer(device.queue.read_buffer(result), np.float32).reshape(-1, 4)

    def _resource(self, held: Any) -> tuple[dict[str, Any], Any]:
        """The bind-group layout entry of a sampler, a picture or a buffer, and the resource."""
        if isinstance(held, str):
            kind = "filtering" if held == "linear" else "non-filtering"
            return {"sampler": {"type": kind}}, self.device.create_sampler(mag_filter=held, min_filter=held)
        if isinstance(held, Picture):
            H, W, _ = held.texels.shape
            usage = self.wgpu.TextureUsage.TEXTURE_BINDING | self.wgpu.TextureUsage.COPY_DST
            texture = self.device.create_texture(size=(W, H, 1), format="rgba32float", usage=usage)
            texels = np.ascontiguousarray(held.texels)
            self.device.queue.write_texture({"texture": texture}, texels, {"bytes_per_row": 16 * W}, (W, H, 1))
            kind = "float" if held.smooth else "unfilterable-float"
            return {"texture": {"sample_type": kind}}, texture.create_view()
        kind = "read-only-storage"
        if isinstance(held, np.ndarray):
            usage = self.wgpu.BufferUsage.STORAGE
            held = self.device.create_buffer_with_data(data=np.ascontiguousarray(held), usage=usage)
        else:
            kind = "storage"
        return {"buffer": {"type": kind}}, {"buffer": held, "offset": 0, "size": held.size}


class Hlsl:
    """Compiles HLSL to SPIR-V with glslang and runs it with wgpu. Microsoft's compilers are not available here."""

    language = "hlsl"

    def __init__(self, folder: Path) -> None:
        if shutil.which("glslangValidator") is None:
            pytest.skip(f"no glslangValidator ({_DEBIAN})")
        self.folder, self.wgpu = folder, Wgsl()
        self.made: dict[str, tuple[bytes, dict[str, tuple[int, int]]]] = {}  # by source code: SPIR-V and bindings

    def run(self, parts: Sequence[str], code: str, points: Points, bound: Bound) -> Points:
        code = f"""{text_of("hlsl", parts)}
            {code}
            StructuredBuffer<float4> points;
            RWStructuredBuffer<float4> result;
            {self.main(len(points))}"""
        return self.wgpu.dispatch(*self.compiled(code), points, bound)

    def compile(self, parts: Sequence[str]) -> None:
        self.compiled(text_of("hlsl", parts) + "\n[numthreads(1, 1, 1)] void main() {}")

    @staticmethod
    def main(count: int) -> str:
        return f"""[numthreads({_GROUP}, 1, 1)] void main(uint3 id : SV_DispatchThreadID) {{
                if (id.x < {count}u) result[id.x] = answer(points[id.x]);
            }}"""

    def compiled(self, code: str) -> tuple[bytes, dict[str, tuple[int, int]]]:
        """The SPIR-V of source code with a main, and the group and binding of each name. Results are cached."""
        if code not in self.made:
            (self.folder / "code.hlsl").write_text(code)
            made = "harmonics.hlsl"  # of the GLSL file: the package has none
            (self.folder / made).write_text(shader_text(f"hlsl/{made}"))
            command = [
                "glslangValidator",
                "-D",
                "-V",
                "-e",
                "main",
                "-S",
                "comp",
                "--amb",
                "-q",
                "-o",
                "code.spv",
                "-I.",
            ]
            done = subprocess.run(
                [*command, f"-I{HOME / 'hlsl'}", "code.hlsl"],
                cwd=self.folder,
                capture_output=True,
                text=True,
                check=False,
            )
            assert done.returncode == 0, done.stdout
            names = re.findall(r"^(\w+): .* binding (\d+)", done.stdout, re.MULTILINE)
            names += re.findall(r"(\w+) ?: ?register\([tu](\d+)\)", code)
            places = {name: (0, int(at)) for name, at in names}
            self.made[code] = (self.folder / "code.spv").read_bytes(), places
        return self.made[code]
