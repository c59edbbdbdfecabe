"""Light from environment maps: constant maps by hand, and a brute-force integral."""

from __future__ import annotations

import numpy as np
import pytest

from nerfbake.kernels.surface import light

CONSTANT = np.full((16, 32, 3), (0.5, 1.0, 2.0), np.float32)


def test_the_irradiance_of_a_constant_map_is_pi_and_filters_keep_it() -> None:
    found = light.sources(CONSTANT, 8)
    assert found.angles.sum() == pytest.approx(4 * np.pi, rel=0.01)
    np.testing.assert_allclose(light.filtered(found, light.DIFFUSE, 8) / CONSTANT[0, 0], np.pi, rtol=1e-6)
    for roughness in (0.3, 1.0):
        framed = light.filtered(found, roughness, 8)
        np.testing.assert_allclose(framed / CONSTANT[0, 0], 1, rtol=1e-6)
        np.testing.assert_allclose(light.looked_up(framed, np.eye(3, dtype=np.float32)), CONSTANT[0, :3], rtol=1e-6)


def test_directions_are_those_of_blender() -> None:
    # The middle of a row is +x, a quarter to its left is +y, the top is +z.
    found = light.sources(np.ones((64, 128, 3), np.float32), 64).directions.reshape(64, 128, 3)
    np.testing.assert_allclose(found[31:33, 63:65].mean(axis=(0, 1)), (1, 0, 0), atol=0.01)
    np.testing.assert_allclose(found[31:33, 31:33].mean(axis=(0, 1)), (0, 1, 0), atol=0.01)
    np.testing.assert_allclose(found[0].mean(axis=0), (0, 0, 1), atol=0.01)


def test_a_lobe_looks_where_it_points_and_is_wider_if_rough() -> None:
    spot = np.zeros((32, 64, 3), np.float32)
    spot[15:17, 15:17] = 1  # +y
    found = light.sources(spot, 32)
    axes = np.concatenate([np.eye(3), -np.eye(3)]).astype(np.float32)
    sharp, wide = (light.looked_up(light.filtered(found, each, 33), axes)[:, 0] for each in (0.3, 0.8))
    assert sharp.argmax() == wide.argmax() == 1
    assert sharp[1] > 4 * wide[1] > 0
    assert sharp[4] == 0


@pytest.mark.parametrize("roughness", [0.25, 0.6, 1.0])
def test_reflectances_are_the_brute_force_integral(roughness: float) -> None:
    # The BRDF times n.l over the hemisphere, on a grid of 400 x 400 angles.
    theta, phi = np.meshgrid((np.arange(800) + 0.5) / 800 * np.pi / 2, (np.arange(800) + 0.5) / 800 * 2 * np.pi)
    l = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=-1)  # noqa: E741
    table, squared = light.reflectances(roughness), roughness**4
    for number in (20, 45, 63):
        nv = number / 63
        v = np.array([np.sqrt(1 - nv * nv), 0, nv])
        h = (l + v) / np.linalg.norm(l + v, axis=-1, keepdims=True)
        nh, nl, vh = h[..., 2], l[..., 2], (h * v).sum(axis=-1)
        d = squared / (np.pi * (nh * nh * (squared - 1) + 1) ** 2)
        smith = nl * np.sqrt(nv * nv * (1 - squared) + squared) + nv * np.sqrt(nl * nl * (1 - squared) + squared)
        brdf = d * 0.5 / smith * (0.04 + 0.96 * (1 - vh) ** 5)
        whole = (brdf * nl * np.sin(theta)).sum() * (np.pi / 2 / 800) * (2 * np.pi / 800)
        assert table[number] == pytest.approx(whole, rel=0.03)


@pytest.mark.parametrize("roughness", [0.4, 0.8])
def test_highlights_under_a_constant_map_are_the_reflectances(roughness: float) -> None:
    # Two independent sums of one integral: over directions of light, and over half vectors.
    found = light.sources(np.ones((128, 256, 3), np.float32), 128)
    nv = np.array([20, 45, 63]) / 63
    toward = np.stack([np.sqrt(1 - nv * nv), np.zeros(3), nv], axis=1).astype(np.float32)
    normals = np.tile(np.array([[0, 0, 1]], np.float32), (3, 1))
    shown = light.highlights(found, normals, toward, roughness)
    np.testing.assert_allclose(shown[:, 0], light.reflectances(roughness)[[20, 45, 63]], rtol=0.03)


def test_a_highlight_is_where_the_light_is_mirrored() -> None:
    spot = np.zeros((128, 256, 3), np.float32)
    spot[63:65, 127:129] = 1  # +x, within one degree
    found, half = light.sources(spot, 128), np.sqrt(0.5)
    normals = np.tile(np.array([[half, 0, half]], np.float32), (2, 1))
    mirrored, beside = light.highlights(found, normals, np.array([[0, 0, 1], [0, 0.6, 0.8]], np.float32), 0.4)[:, 0]
    assert beside < 0.1 * mirrored
    # By hand: D = 1 / (pi a^2), V = 1 / (4 cos sqrt(cos^2 (1 - a^2) + a^2)), F at 45 degrees.
    squared = 0.4**4
    visible = 1 / (4 * half * np.sqrt(half**2 * (1 - squared) + squared))
    fresnel = 0.04 + 0.96 * (1 - half) ** 5
    by_hand = 1 / (np.pi * squared) * visible * fresnel * half * found.light[:, 0].sum()
    assert mirrored == pytest.approx(by_hand, rel=0.03)
