"""The spherical harmonics' twins in each language, against the program's own."""

from __future__ import annotations

import re

import numpy as np
import pytest

from nerfbake.kernels.march.sh import sh_basis
from nerfbake.kernels.maths.elementary import fibonacci
from tests.support.shaders import LANGUAGES, Runner, text_of

COUNT = 25 * 4_000
# Three functions of the first b * b, from number k on, where w is 25 b + k.
CODES = {
    "glsl": """
        vec4 answer(vec4 p) {
            int b = int(p.w) / 25, k = int(p.w) % 25;
            Harmonics h = harmonics(p.xyz, b * b);
            return vec4(h.f[k], h.f[(k + 1) % 25], h.f[(k + 2) % 25], sigmoid(p.xyz).x);
        }""",
    "hlsl": """
        float4 answer(float4 p) {
            int b = int(p.w) / 25, k = int(p.w) % 25;
            Harmonics h = harmonics(p.xyz, b * b);
            return float4(h.f[k], h.f[(k + 1) % 25], h.f[(k + 2) % 25], sigmoid(p.xyz).x);
        }""",
    "wgsl": """
        fn answer(p: vec4f) -> vec4f {
            let b = i32(p.w) / 25;
            let k = i32(p.w) % 25;
            var h = harmonics(p.xyz, b * b);
            return vec4f(h.f[k], h.f[(k + 1) % 25], h.f[(k + 2) % 25], sigmoid(p.xyz).x);
        }""",
}


def test_functions_are_the_programs_own(runner: Runner) -> None:
    points = np.zeros((COUNT, 4), np.float32)
    points[:, :3] = np.random.default_rng(0).permutation(fibonacci(COUNT))
    k, b = np.arange(COUNT) % 25, np.arange(COUNT) // 25 % 5 + 1
    points[:, 3] = 25 * b + k
    found = runner.run(("harmonics",), CODES[runner.language], points, {})
    wanted = sh_basis(points[:, :3].astype(np.float64), 25)
    wanted[np.arange(25) >= (b * b)[:, None]] = 0
    for column in range(3):
        np.testing.assert_allclose(found[:, column], wanted[np.arange(COUNT), (k + column) % 25], atol=2e-6)
    np.testing.assert_allclose(found[:, 3], 1 / (1 + np.exp(-points[:, 0].astype(np.float64))), atol=1e-6)


@pytest.mark.parametrize("language", LANGUAGES)
def test_coefficients_have_the_names_of_their_bands_and_orders(language: str) -> None:
    named = re.findall(r"SH_(\d)_(0|[MP]\d) = (\d+)", text_of(language, ("harmonics",)))
    wanted = [(band, order) for band in range(5) for order in range(-band, band + 1)]
    assert [int(place) for *_, place in named] == list(range(25))
    assert [(int(band), int(order.replace("M", "-").replace("P", ""))) for band, order, _ in named] == wanted
