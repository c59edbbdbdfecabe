"""Features and MLP from photographs of a glossy torus: highlights come back, and what is fitted is what is rendered."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from nerfbake import (
    Cameras,
    Meshes,
    Stage1,
    Views,
    bake_stage1,
    fit_specular,
    fit_texture,
    memory_limit,
    render_meshes,
    render_stage1,
    sample_stage1,
)
from nerfbake.errors import InvalidScene, MemoryLimit
from nerfbake.kernels.arrays import Floats
from nerfbake.kernels.surface import specular
from nerfbake.scene.mesh import Mesh
from nerfbake.stages._texels import see
from tests.stages.test_views_to_texture import around

EDGE = 64


@cache
def glossy() -> Stage1:
    return sample_stage1(resolution=EDGE)


def torus() -> Mesh:
    (mesh,) = glossy().meshes
    assert mesh is not None
    return mesh


@cache
def photographed(count: int = 24, edge: int = 48) -> Views:
    cameras = around(count, edge)
    pictures = []
    for camera in cameras.cameras:
        image = render_stage1(glossy(), camera, samples=2)
        pictures.append(np.dstack([np.rint(255 * image.colour), np.full(image.alpha.shape, 255)]).astype(np.uint8))
    return Views(cameras, tuple(pictures), (1.0, 1.0, 1.0), False)


@cache
def fitted() -> Stage1:
    return fit_specular(torus(), photographed(), edge=EDGE)


def error(scene: Stage1 | Mesh, views: Views) -> float:
    """PSNR over all views."""
    squares = []
    for i, camera in enumerate(views.cameras.cameras):
        if isinstance(scene, Stage1):
            made = render_stage1(scene, camera, samples=2)
        else:
            made = render_meshes(Meshes((scene,)), camera, samples=2)
        squares.append(float(((made.colour - views.photograph(i)) ** 2).mean()))
    return float(-10 * np.log10(np.mean(squares)))


def test_highlights_come_back_in_views_that_were_not_fitted() -> None:
    others = photographed(13, 40)
    plain = error(fit_texture(torus(), photographed(), edge=EDGE), others)
    with_highlights = error(fitted(), others)
    assert with_highlights > plain + 1.2
    assert with_highlights > 33


def test_the_result_is_a_stage1_scene_that_bakes() -> None:
    (field,), (mesh,) = fitted().fields, fitted().meshes
    assert field.features.shape == (EDGE, EDGE, 3)
    assert field.w0.shape == (6, 32)
    assert mesh is not None
    assert mesh.texture is not None
    assert mesh.texture.shape == (EDGE, EDGE, 3)
    atlas = bake_stage1(fitted(), clusters=16)
    camera = around(2).cameras[1]
    exact = render_stage1(fitted(), camera).colour
    assert float(((render_stage1(atlas, camera).colour - exact) ** 2).mean()) < 1e-3


def test_what_is_fitted_is_what_is_rendered() -> None:
    # The torus fills no pixel of the rim alone: pixels that it covers wholly have the mean of their rays.
    scene, views = glossy(), photographed(2)
    seen = see(torus(), views, EDGE, 2)
    (field,) = scene.fields
    shown = np.empty_like(seen.targets)
    features = (field.features / np.float32(255)).astype(np.float32)
    specular.specular(*seen.lookups, seen.directions, features, field.w0, field.w1, True, shown)
    black = Mesh(torus().positions, torus().uvs, torus().faces, np.zeros((2, 2, 3), np.uint8))
    dark = Stage1(scene.fields, (black,))
    made = [render_stage1(dark, camera, samples=2, background=(0, 0, 0)) for camera in views.cameras.cameras]
    colour = np.concatenate([image.colour[image.alpha > 0] for image in made])
    alpha = np.concatenate([image.alpha[image.alpha > 0] for image in made])
    np.testing.assert_array_equal(seen.cover, alpha)
    # A ray's direction is that of its pixel's centre here.
    np.testing.assert_allclose(shown[alpha == 1], colour[alpha == 1], atol=0.02)
    assert abs(float((shown[alpha == 1] - colour[alpha == 1]).mean())) < 1e-4
    # The quicker colours are near, and equal where all lookups have the same feature.
    quick, plain = np.empty_like(shown), np.full_like(features, 0.3)
    specular.specular(*seen.lookups, seen.directions, features, field.w0, field.w1, False, quick)
    assert float(np.abs(quick - shown).mean()) < 0.01
    for exact, out in ((True, shown), (False, quick)):
        specular.specular(*seen.lookups, seen.directions, plain, field.w0, field.w1, exact, out)
    np.testing.assert_allclose(quick, shown, atol=1e-5)


def test_slopes_are_those_of_the_error() -> None:
    random = np.random.default_rng(0)
    p, hidden = 20, specular.HIDDEN
    w0, w1 = random.normal(size=(6, hidden)), random.normal(0, 0.3, (hidden, 3))
    features, directions = random.random((4, 4, 3)), random.normal(size=(p, 3))
    rest, weights = random.random((p, 3)), random.random(p)
    at, starts = random.uniform(0, 3, (p, 2)).astype(np.float32), np.arange(p + 1).astype(np.int32)

    def loss(w0: Floats, w1: Floats, features: Floats) -> Floats:
        x, y = np.rint(at).astype(int).T
        inputs = np.concatenate([directions, features[y, x]], axis=1)
        made = 1 / (1 + np.exp(-np.maximum(inputs @ w0, 0) @ w1))
        return np.asarray(0.5 * weights * ((made - rest) ** 2).sum(axis=1))

    looks, shares, wanted, held = (each.astype(np.float32) for each in (directions, weights, rest, features))
    by_weight = np.empty((1, 9, hidden), np.float32)
    by_feature = np.zeros((1, specular.BLOCK, 6), np.float32)
    single = w0.astype(np.float32), w1.astype(np.float32)
    specular.slopes(np.array([0]), at, starts, looks, shares, wanted, held, *single, by_weight, by_feature)
    small = 1e-5
    for row, k in ((0, 3), (4, 17), (7, 30)):
        moved0, moved1 = w0.copy(), w1.copy()
        if row < 6:
            moved0[row, k] += small
        else:
            moved1[k, row - 6] += small
        slope = (loss(w0, w1, features).sum() - loss(moved0, moved1, features).sum()) / small
        assert by_weight[0, row, k] == pytest.approx(slope, rel=2e-2, abs=1e-4)
    for axis in range(3):
        moved_features = features.copy()
        moved_features[..., axis] += small
        slope = (loss(w0, w1, features) - loss(w0, w1, moved_features)) / small
        np.testing.assert_allclose(by_feature[0, :p, axis], slope, rtol=2e-2, atol=1e-4)
    assert (by_feature[0, :p, 3:] >= 0).all()
    assert (by_feature[0, p:] == 0).all()


def test_threads_do_not_matter_and_the_seed_does(monkeypatch: pytest.MonkeyPatch) -> None:
    views = photographed(4, 32)
    monkeypatch.setenv("NUMBA_NUM_THREADS", "3")
    first = fit_specular(torus(), views, edge=32)
    monkeypatch.setenv("NUMBA_NUM_THREADS", "1")
    second = fit_specular(torus(), views, edge=32)
    other = fit_specular(torus(), views, edge=32, seed=1)
    (a,), (b,), (c,) = first.fields, second.fields, other.fields
    for name in ("features", "w0", "w1"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))
    assert (a.w0 != c.w0).any()
    (x,), (y,) = first.meshes, second.meshes
    assert x is not None
    assert y is not None
    np.testing.assert_array_equal(x.texture, y.texture)


def test_what_cannot_be_fitted_is_refused() -> None:
    views = photographed(2)
    behind = Views(Cameras(tuple(around(2).cameras)), views.pictures, views.background, False)
    away = Mesh(torus().positions + np.float32(100), torus().uvs, torus().faces)
    with pytest.raises(InvalidScene, match="the mesh is not visible in any picture"):
        fit_specular(away, behind, edge=EDGE)
    with memory_limit(1 << 20), pytest.raises(MemoryLimit, match="textures of 512x512"):
        fit_specular(torus(), views, edge=512)
