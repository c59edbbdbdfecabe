"""Textures from photographs: a known texture comes back, and wrong pixels do not stain it."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from nerfbake import (
    Camera,
    Cameras,
    Mesh,
    Meshes,
    Views,
    fit_texture,
    memory_limit,
    render_meshes,
    sample_stage1,
    unwrap_surface,
)
from nerfbake.errors import InvalidScene, MemoryLimit
from nerfbake.kernels.surface import texels
from nerfbake.scene.camera import look_at
from tests.support.meshes import cube, square, straight_down

EDGE = 64
GREY = (0.5, 0.25, 0.75)


def around(count: int = 10, edge: int = 48) -> Cameras:
    """Cameras around the torus, above and below."""
    poses = [look_at(np.zeros(3), 2.4 * i, (-1.2, -0.5, 0.2, 0.8, 1.3)[i % 5], 2.8) for i in range(count)]
    return Cameras(tuple(Camera(edge, edge, 1.2 * edge, pose, f"{i}") for i, pose in enumerate(poses)))


def photographed(mesh: Mesh, cameras: Cameras) -> Views:
    """2 x 2 rays a pixel, without alpha."""
    pictures = []
    for camera in cameras.cameras:
        image = render_meshes(Meshes((mesh,)), camera, background=GREY, samples=2)
        opaque = np.full(image.alpha.shape, 255, np.uint8)
        pictures.append(np.dstack([np.rint(255 * image.colour).astype(np.uint8), opaque]))
    return Views(cameras, tuple(pictures), GREY, False)


@cache
def torus() -> Mesh:
    """The glossy torus' mesh and diffuse colours, on charts of its own."""
    (mesh,) = sample_stage1(resolution=EDGE).meshes
    assert mesh is not None
    return mesh


def error(mesh: Mesh, views: Views) -> float:
    """PSNR of pictures of the mesh."""
    square = []
    for i, camera in enumerate(views.cameras.cameras):
        made = render_meshes(Meshes((mesh,)), camera, background=views.background, samples=2).colour
        square.append(float(((made - views.photograph(i)) ** 2).mean()))
    return float(-10 * np.log10(np.mean(square)))


def test_a_plain_colour_is_the_same_in_every_texel() -> None:
    plain = replace(unwrap_surface(cube(), edge=EDGE), texture=np.full((2, 2, 3), (10, 200, 77), np.uint8))
    fitted = fit_texture(plain, photographed(plain, around(6, 24)), edge=EDGE)
    assert fitted.texture is not None
    assert fitted.texture.shape == (EDGE, EDGE, 3)
    assert np.abs(fitted.texture.astype(int) - (10, 200, 77)).max() <= 1  # also between charts, and where no view looks
    assert fitted.uvs is plain.uvs


def test_texels_by_hand() -> None:
    # A square of 16 x 16 texels fills a picture: 16 pixels show each texel. Lookups beside the outer texels read those
    # of the other side, which charts never do.
    y, x = np.mgrid[:16, :16]
    shown = np.stack([10 * y, 10 * x, 100 + (x + y) % 2], axis=-1).astype(np.uint8)
    flat = replace(square(half=1.0), texture=shown)
    fitted = fit_texture(flat, photographed(flat, Cameras((straight_down(64, 64, 64.0),))), edge=16).texture
    assert fitted is not None
    np.testing.assert_allclose(fitted[4:-4, 4:-4], shown[4:-4, 4:-4], atol=2)


def test_the_torus_gets_its_texture_back() -> None:
    views = photographed(torus(), around())
    fitted = fit_texture(torus(), views, edge=EDGE)
    assert error(fitted, views) > 38
    other = photographed(torus(), around(13).chosen(size=(40, 40)))
    assert error(fitted, other) > 36


def test_a_wrong_photograph_does_not_stain_the_texture() -> None:
    views = photographed(torus(), around(20))
    wrong = tuple(np.where(np.arange(20)[i] == 7, 255 - p, p).astype(np.uint8) for i, p in enumerate(views.pictures))
    wrong[7][..., 3] = 255
    stained = fit_texture(torus(), replace(views, pictures=wrong), edge=EDGE)
    assert error(stained, views) > 30


def test_rims_do_not_take_the_background_and_alpha_is_used() -> None:
    dark = replace(torus(), texture=np.full((4, 4, 3), 20, np.uint8))
    views = photographed(dark, around(6))
    fitted = fit_texture(dark, views, edge=EDGE).texture
    assert fitted is not None
    assert np.abs(fitted.astype(int) - 20).max() <= 3


def test_pixels_that_are_not_used_have_no_influence() -> None:
    views = photographed(torus(), around(6))
    hidden = [picture.copy() for picture in views.pictures]
    for picture in hidden:
        picture[:, :10] = (255, 0, 255, 0)
    kept = fit_texture(torus(), replace(views, pictures=tuple(hidden), masked=True, scenery=True), edge=EDGE).texture
    assert kept is not None
    assert not ((kept[..., 0] > 250) & (kept[..., 1] < 5)).any()


def test_threads_do_not_matter(monkeypatch: pytest.MonkeyPatch) -> None:
    views = photographed(torus(), around(4))
    monkeypatch.setenv("NUMBA_NUM_THREADS", "3")
    first = fit_texture(torus(), views, edge=EDGE).texture
    monkeypatch.setenv("NUMBA_NUM_THREADS", "1")
    second = fit_texture(torus(), views, edge=EDGE).texture
    np.testing.assert_array_equal(first, second)


def test_conjugate_gradients_solve_what_couple_and_smooth_describe() -> None:
    random = np.random.default_rng(0)
    at, starts = random.uniform(0, 4.999, (60, 2)).astype(np.float32), np.arange(61).astype(np.int32)
    weights, used = random.uniform(0.5, 1, 60).astype(np.float32), np.ones((6, 6), bool)
    matrix = np.zeros((6, 6, 5), np.float32)
    texels.couple(at, starts, weights, matrix)
    texels.smooth(used, 0.3, matrix)
    truth = random.random((6, 6, 3)).astype(np.float32)
    # The same operator, by lookups: residuals of 0 targets are minus the lookups; spread() is their transpose.
    looked = np.empty((60, 3), np.float32)
    texels.residuals(at, starts, truth, np.zeros((60, 3), np.float32), looked)
    right = -texels.roughness(truth, used, 0.3)
    texels.spread(at, starts, weights, -looked, right)
    np.testing.assert_allclose(texels.solve(matrix, right, used, 60), truth, atol=1e-3)


def test_holes_continue_what_is_around_them() -> None:
    known = np.zeros((9, 7), bool)
    known[0], known[8] = True, True
    ramp = np.broadcast_to(np.arange(9, dtype=np.float32)[:, None, None], (9, 7, 1)).copy()
    filled = texels.fill(ramp, known)
    np.testing.assert_array_equal(filled[known], ramp[known])
    assert (np.diff(filled[:, 3, 0]) >= 0).all()
    assert 0 < filled[4, 3, 0] < 8
    assert (texels.fill(ramp, np.zeros((9, 7), bool)) == 0).all()


def test_what_cannot_be_fitted_is_refused() -> None:
    views = photographed(torus(), around(2))
    away = replace(torus(), positions=torus().positions + np.float32(100))
    with pytest.raises(InvalidScene, match="the mesh is not visible in any picture"):
        fit_texture(away, views, edge=EDGE)
    with pytest.raises(InvalidScene, match="the mesh has no texture coordinates"):
        fit_texture(cube(), views, edge=EDGE)
    with memory_limit(1 << 20), pytest.raises(MemoryLimit, match="texture of 512x512"):
        fit_texture(torus(), views, edge=512)
