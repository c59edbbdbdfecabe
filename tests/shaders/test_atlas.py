"""atlas.glsl: its twin in NumPy, line by line, and the shader itself where there is an OpenGL, against the lookups."""

from __future__ import annotations

from importlib.resources import files
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from nerfbake.formats.atlas import document as atlas_json
from nerfbake.formats.atlas import folder as atlas_folder
from nerfbake.formats.wire.texture import decode_texture
from nerfbake.kernels.maths.sphere import fibonacci
from nerfbake.scene.atlas import METHODS, BakedAtlas, Method, OctahedralAtlas
from tests.support.atlas_scenes import looked_up, random_atlas

Floats = npt.NDArray[np.float64]
CALLS = {
    "kmeans": "specularKmeans(atlas, labels, a, uv, d)",
    "affine": "specularAffine(atlas, labels, features, a, uv, d)",
    "grid": "specularGrid(atlas, features, a, uv, d)",
}


def textures(atlas: OctahedralAtlas) -> dict[str, npt.NDArray[np.uint8]]:
    """What a shader gets: the PNGs that are written."""
    written = atlas_folder.encode(BakedAtlas((atlas,), (None,), {}, {}))
    pngs = {name.removesuffix("_0.png"): content for name, content in written if name.endswith(".png")}
    return {role: decode_texture(memoryview(png[0]), role) for role, png in pngs.items()}


def every_texel(atlas: OctahedralAtlas) -> tuple[npt.NDArray[np.int64], Floats]:
    """A direction for each texel, all over the sphere."""
    count = atlas.labels.size
    return np.arange(count), np.random.default_rng(2).permutation(fibonacci(count))


class Twin:
    """atlas.glsl in NumPy: same names, same order."""

    def __init__(self, atlas: OctahedralAtlas) -> None:
        self.pixels = {role: texels / 255 for role, texels in textures(atlas).items()}
        numbers = atlas_json.entry(atlas)
        self.mapSize, self.border = numbers["map_size"], numbers["border"]
        self.tilesPerRow, self.slope, self.n = numbers["tiles_per_row"], numbers.get("slope", 1), numbers.get("n", 2)

    def octahedron(self, d: Floats) -> Floats:
        p = d / np.abs(d).sum(axis=1, keepdims=True)
        folded = (1 - np.abs(p[:, [2, 0]])) * np.where(p[:, [0, 2]] < 0, -1, 1)
        return np.asarray(np.where(p[:, 1:2] >= 0, p[:, [0, 2]], folded) * 0.5 + 0.5)

    def tile(self, index: Floats, octahedral: Floats) -> Floats:
        row = np.floor((index + 0.5) / self.tilesPerRow)
        corner = (
            np.stack([index - row * self.tilesPerRow, row], axis=1) * (self.mapSize + 2 * self.border) + self.border
        )
        return self.linear(corner + octahedral * self.mapSize)

    def linear(self, at: Floats) -> Floats:
        """GL_LINEAR with GL_CLAMP_TO_EDGE over the whole atlas, `at` in texels."""
        image = self.pixels["atlas"]
        low = np.floor(at - 0.5).astype(int)
        f = (at - 0.5 - low)[..., None]

        def fetch(dx: int, dy: int) -> Floats:
            x, y = (np.clip(low[:, k] + d, 0, image.shape[1 - k] - 1) for k, d in enumerate((dx, dy)))
            return np.asarray(image[y, x])

        top = fetch(0, 0) * (1 - f[:, 0]) + fetch(1, 0) * f[:, 0]
        bottom = fetch(0, 1) * (1 - f[:, 0]) + fetch(1, 1) * f[:, 0]
        return np.asarray(top * (1 - f[:, 1]) + bottom * f[:, 1])

    def label(self, texel: Floats) -> Floats:
        return np.asarray(np.floor(texel[:, 0] * 255 + 0.5) + 256 * np.floor(texel[:, 1] * 255 + 0.5))

    def specular(self, method: Method, texels: npt.NDArray[np.int64], d: Floats) -> Floats:
        return {"kmeans": self.kmeans, "affine": self.affine, "grid": self.grid}[method](texels, self.octahedron(d))

    def kmeans(self, texels: npt.NDArray[np.int64], at: Floats) -> Floats:
        return self.tile(self.label(self.pixels["labels"].reshape(-1, 3)[texels]), at)

    def affine(self, texels: npt.NDArray[np.int64], at: Floats) -> Floats:
        texel = self.pixels["labels"].reshape(-1, 3)[texels]
        first = 4 * self.label(texel)
        feature = self.pixels["features"].reshape(-1, 3)[texels]
        offset = (feature - 127 / 255) * self.slope * texel[:, 2:] * 255 / 127
        colour = self.tile(first, at)
        for i in range(3):
            colour = colour + offset[:, i : i + 1] * (self.tile(first + 1 + i, at) - 128 / 255)
        return colour

    def grid(self, texels: npt.NDArray[np.int64], at: Floats) -> Floats:
        p = self.pixels["features"].reshape(-1, 3)[texels] * (self.n - 1)
        low = np.minimum(np.floor(p), self.n - 2)
        f = p - low
        r, g, b = f.T
        before = np.stack([g > r, r >= g, r >= b], axis=1) + np.stack([b > r, b > g, g >= b], axis=1).astype(float)
        stride = np.array([self.n * self.n, self.n, 1])
        steps = [before == rank for rank in range(3)]
        f0, f1, f2 = ((step * f).sum(axis=1) for step in steps)
        node = low @ stride
        colour = (1 - f0)[:, None] * self.tile(node, at)
        for step, weight in zip(steps, (f0 - f1, f1 - f2, f2), strict=True):
            node = node + step @ stride
            colour = colour + weight[:, None] * self.tile(node, at)
        return np.asarray(colour)


@pytest.mark.parametrize("border", [1, 2])
@pytest.mark.parametrize("method", METHODS)
def test_the_twin_shows_what_the_atlas_holds(method: Method, border: int) -> None:
    atlas = random_atlas(method, border)
    texels, directions = every_texel(atlas)
    shown = Twin(atlas).specular(method, texels, directions)
    np.testing.assert_allclose(shown, looked_up(atlas, texels, directions), atol=2e-5)


@pytest.mark.parametrize("method", METHODS)
def test_the_shader_shows_what_the_atlas_holds(method: Method) -> None:
    atlas = random_atlas(method)
    texels, directions = every_texel(atlas)
    shown = run_shader(atlas, texels, directions)
    np.testing.assert_allclose(shown, looked_up(atlas, texels, directions), atol=1e-4)


def run_shader(atlas: OctahedralAtlas, texels: npt.NDArray[np.int64], directions: Floats) -> Floats:
    """atlas.glsl on an OpenGL without a window, a pixel for each texel."""
    moderngl = pytest.importorskip("moderngl")
    try:
        context = moderngl.create_standalone_context(backend="egl", require=330)
    except Exception as error:
        pytest.skip(f"no OpenGL here: {error}")
    H, W = atlas.labels.shape
    shader = (files("nerfbake") / "shaders" / "glsl" / "atlas.glsl").read_text()
    main = f"""
        uniform sampler2D atlas, labels, features, directions; uniform Atlas a; out vec4 result;
        void main() {{
            vec2 uv = gl_FragCoord.xy / vec2({W}, {H});
            vec3 d = texelFetch(directions, ivec2(gl_FragCoord.xy), 0).xyz;
            result = vec4({CALLS[atlas.method]}, 1);
        }}"""
    vertex = "#version 330\nin vec2 p; void main() { gl_Position = vec4(p, 0, 1); }"
    program = context.program(vertex_shader=vertex, fragment_shader="#version 330\n" + shader + main)
    numbers = atlas_json.entry(atlas)
    uniforms = {"mapSize": "map_size", "border": "border", "tilesPerRow": "tiles_per_row", "slope": "slope", "n": "n"}
    for name, key in uniforms.items():
        if f"a.{name}" in program:
            program[f"a.{name}"].value = float(numbers.get(key, 0))
    # Floats, because some filters round 8-bit texels to 8 bits between them.
    images: dict[str, Any] = {role: np.float32(pixels / 255) for role, pixels in textures(atlas).items()}
    images["directions"] = directions.reshape(H, W, 3).astype(np.float32)
    for unit, (name, image) in enumerate(images.items()):
        if name in program:
            texture = context.texture(image.shape[1::-1], 3, image.tobytes(), dtype="f4")
            texture.filter = (moderngl.LINEAR,) * 2 if name == "atlas" else (moderngl.NEAREST,) * 2
            texture.repeat_x = texture.repeat_y = False
            texture.use(unit)
            program[name].value = unit
    target = context.framebuffer([context.renderbuffer((W, H), 4, dtype="f4")])
    target.use()
    corners = context.buffer(np.array([-1, -1, 3, -1, -1, 3], np.float32).tobytes())
    context.vertex_array(program, [(corners, "2f", "p")]).render()
    pixels = np.frombuffer(target.read(components=4, dtype="f4"), np.float32).reshape(-1, 4)
    return np.asarray(pixels[texels, :3], np.float64)
