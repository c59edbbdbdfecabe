"""The atlas in each language, and atlas.glsl line by line in NumPy, against the program's own lookups; the MLP, too."""

from __future__ import annotations

import re
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from nerfbake.formats.atlas import folder as atlas_folder
from nerfbake.formats.atlas import folder as atlas_json
from nerfbake.formats.wire.picture import decode_texture
from nerfbake.kernels.maths.elementary import fibonacci
from nerfbake.kernels.surface.mlp import evaluate_each
from nerfbake.scene.atlas import METHODS, BakedAtlas, Method, OctahedralAtlas
from tests.support.atlas_scenes import field, looked_up, random_atlas
from tests.support.shaders import Picture, Runner

Floats = npt.NDArray[np.float64]
COUNT = 102_000
# Of a direction and the number of a texel what the atlas shows. GLSL is handed the textures, the others have them.
CALLS = {
    "kmeans": ("specularKmeans(atlas, labels, a, uv, p.xyz)", "specularKmeans(a, uv, p.xyz)"),
    "affine": ("specularAffine(atlas, labels, features, a, uv, p.xyz)", "specularAffine(a, uv, p.xyz)"),
    "grid": ("specularGrid(atlas, features, a, uv, p.xyz)", "specularGrid(a, uv, p.xyz)"),
}
CODES = {
    "glsl": """
        uniform sampler2D atlas;
        uniform sampler2D labels;
        uniform sampler2D features;
        vec4 answer(vec4 p) {
            Atlas a = Atlas(SIZE, BORDER, ROW, SLOPE, N);
            vec2 uv = (vec2(mod(p.w, WIDTH), floor(p.w / WIDTH)) + 0.5) / vec2(WIDTH, HEIGHT);
            return vec4(METHOD, 1);
        }""",
    "hlsl": """
        float4 answer(float4 p) {
            Atlas a = {SIZE, BORDER, ROW, SLOPE, N};
            float2 uv = (float2(fmod(p.w, WIDTH), floor(p.w / WIDTH)) + 0.5) / float2(WIDTH, HEIGHT);
            return float4(METHOD, 1);
        }""",
    "wgsl": """
        fn answer(p: vec4f) -> vec4f {
            let a = Atlas(SIZE, BORDER, ROW, SLOPE, N);
            let uv = (vec2f(p.w % WIDTH, floor(p.w / WIDTH)) + 0.5) / vec2f(WIDTH, HEIGHT);
            return vec4f(METHOD, 1);
        }""",
}
MLP = {
    "glsl": """
        uniform sampler2D given;
        float at(int i) { return fetchFloat(given, i); }
        vec4 answer(vec4 p) {
            int i = 3 * int(p.w);
            return vec4(specularMlp(HIDDEN, p.xyz, vec3(at(i), at(i + 1), at(i + 2))), 1);
        }""",
    "hlsl": """
        StructuredBuffer<float> given;
        float4 answer(float4 p) {
            int i = 3 * int(p.w);
            return float4(specularMlp(HIDDEN, p.xyz, float3(given[i], given[i + 1], given[i + 2])), 1);
        }""",
    "wgsl": """
        @group(0) @binding(2) var<storage, read> given: array<f32>;
        fn answer(p: vec4f) -> vec4f {
            let i = 3 * i32(p.w);
            return vec4f(specularMlp(HIDDEN, p.xyz, vec3f(given[i], given[i + 1], given[i + 2])), 1);
        }""",
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
        numbers = atlas_json.cascade_entry(atlas)
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


@pytest.fixture(scope="module")
def looks() -> tuple[npt.NDArray[np.int64], npt.NDArray[np.float32]]:
    """Texels of random_atlas(), all of them many times, and as many directions."""
    texels = np.arange(COUNT) % 600
    return texels, np.random.default_rng(2).permutation(fibonacci(COUNT)).astype(np.float32)


@pytest.mark.parametrize("method", METHODS)
def test_the_shader_shows_what_the_atlas_holds(method: Method, runner: Runner, looks: Any) -> None:
    atlas = random_atlas(method)
    assert_shown(runner, atlas, *looks, atol=1e-4)  # of a texel's place in the whole atlas, float32 has no more


@pytest.mark.parametrize("method", METHODS)
def test_the_shader_never_takes_another_map(method: Method, runner: Runner, looks: Any) -> None:
    """Each map has one colour, so that it does not matter where in it a direction is."""
    atlas = random_atlas(method)
    flat = replace(atlas, tiles=np.broadcast_to(atlas.tiles[:, :1, :1], atlas.tiles.shape).copy())
    assert_shown(runner, flat, *looks, atol=1e-5)


def assert_shown(
    runner: Runner,
    atlas: OctahedralAtlas,
    texels: npt.NDArray[np.int64],
    directions: npt.NDArray[np.float32],
    *,
    atol: float,
) -> None:
    # Floats, because some filters round 8-bit texels to 8 bits between them.
    pictures: dict[str, Any] = {}
    given: dict[str, npt.NDArray[Any]] = {"features": np.zeros((1, 1, 3)), **textures(atlas)}
    for role, pixels in given.items():
        texels4 = np.ones((*pixels.shape[:2], 4), np.float32)
        texels4[..., :3] = pixels / 255
        pictures[role] = Picture(texels4, smooth=role == "atlas")
    numbers: dict[str, Any] = {"slope": 0, "n": 0, **atlas_json.cascade_entry(atlas)}
    H, W = atlas.labels.shape
    code = CODES[runner.language].replace("METHOD", CALLS[atlas.method][runner.language != "glsl"])
    for name, key in {
        "SIZE": "map_size",
        "BORDER": "border",
        "ROW": "tiles_per_row",
        "SLOPE": "slope",
        "N": "n",
    }.items():
        code = re.sub(rf"\b{name}\b", f"{float(numbers[key])}", code)
    code = code.replace("WIDTH", f"{W}.0").replace("HEIGHT", f"{H}.0")
    points = np.column_stack([directions, texels]).astype(np.float32)
    found = runner.run(("common", "atlas"), code, points, pictures)[:, :3]
    features = None if atlas.features is None else atlas.features.reshape(-1, 3)[texels]
    wanted = atlas.specular(atlas.labels.reshape(-1)[texels], features, directions.astype(np.float64))
    np.testing.assert_allclose(found, wanted, atol=atol)


def test_the_mlp_is_the_programs_own(runner: Runner, looks: Any) -> None:
    texels, directions = looks
    scene = field()
    features = scene.features.reshape(-1, 3)[texels] / np.float32(255)
    code = MLP[runner.language].replace("HIDDEN", str(scene.w0.shape[1]))
    bound = {"weights0": scene.w0.T.ravel(), "weights1": scene.w1.ravel(), "given": features.ravel()}
    points = np.column_stack([directions, np.arange(COUNT)]).astype(np.float32)
    found = runner.run(("common", "mlp"), code, points, bound)[:, :3]
    wanted = evaluate_each(features, directions, scene.w0, scene.w1)
    np.testing.assert_allclose(found, wanted, atol=1e-5)
