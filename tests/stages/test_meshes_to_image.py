"""Meshes as pictures."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from nerfbake import Meshes, orbit_cameras, render_meshes
from tests.support.meshes import camera, cube, sphere, square, straight_down

TEXELS = np.array([[[255, 0, 0], [0, 255, 0]], [[0, 0, 255], [255, 255, 255]]], np.uint8)


def test_colour_alpha_and_depth_by_hand() -> None:
    # From 2 above, 4 x 4 pixels of half a unit: the middle four see the square's four quarters.
    textured = replace(square(half=0.5), texture=TEXELS)
    image = render_meshes(Meshes((textured,)), straight_down(4, 4), background=None)
    np.testing.assert_array_equal(image.alpha, [[0, 0, 0, 0], [0, 1, 1, 0], [0, 1, 1, 0], [0, 0, 0, 0]])
    np.testing.assert_allclose(image.colour[1:3, 1:3], TEXELS / 255, atol=1e-6)
    np.testing.assert_array_equal(image.colour[0], 0)
    np.testing.assert_allclose(image.depth[1:3, 1:3], np.sqrt(2**2 + 2 * 0.25**2), rtol=1e-6)
    assert image.depth[0, 0] == 0
    over = render_meshes(Meshes((textured,)), straight_down(4, 4), background=(0.0, 0.5, 1.0))
    np.testing.assert_allclose(over.colour[0, 0], [0, 0.5, 1])
    np.testing.assert_array_equal(over.colour[1:3, 1:3], image.colour[1:3, 1:3])


def test_without_a_texture_a_surface_is_lit_from_the_camera() -> None:
    bright = render_meshes(Meshes((square(),)), straight_down(4, 4)).colour[2, 2]
    grazing = render_meshes(Meshes((square(),)), camera(4, 4, elevation=0.2)).colour[2, 2]
    np.testing.assert_allclose(bright, 0.75, atol=0.02)
    assert (grazing < 0.5 * bright).all()
    np.testing.assert_array_equal(bright, bright[0])


def test_radiance_at_vertices_is_shown_without_light() -> None:
    painted = replace(square(), colours=np.full((4, 3), (0.2, 0.6, 1), np.float32))
    for view in (straight_down(4, 4), camera(4, 4, elevation=0.2)):
        np.testing.assert_allclose(render_meshes(Meshes((painted,)), view, lit=False).colour[2, 2], [0.2, 0.6, 1])


def test_vertex_colours_are_mixed() -> None:
    colours = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [0, 0, 0]], np.float32)
    image = render_meshes(Meshes((replace(square(half=1.0), colours=colours),)), straight_down(401, 401, 400.0))
    np.testing.assert_allclose(image.colour[200, 200], [0.5, 0, 0.5], atol=0.01)  # on the diagonal, half way
    tinted = replace(square(half=1.0), texture=TEXELS, colours=colours)
    assert (render_meshes(Meshes((tinted,)), straight_down()).colour[1, 2] < [0.6, 0.6, 0.6]).all()


def test_the_nearer_of_two_meshes_is_seen() -> None:
    near = replace(cube(0.4), colours=np.full((8, 3), [1, 0, 0], np.float32))
    far = replace(sphere(), colours=np.full((len(sphere().positions), 3), [0, 0, 1], np.float32))
    lifted = replace(near, positions=near.positions + np.array([0, 0, 1.2], np.float32))
    for order in ((lifted, far), (far, lifted)):
        image = render_meshes(Meshes(order), straight_down(41, 41, 40.0, 5.0))
        assert image.colour[20, 20, 0] > 0.9
        assert image.colour[20, 27, 2] > 0.5
        assert image.colour[20, 27, 0] == 0


def test_the_orbit_frames_the_mesh() -> None:
    scene = Meshes((cube(0.3), replace(cube(0.1), positions=cube(0.1).positions + np.float32(2))))
    for view in orbit_cameras(scene, frames=5, width=60, height=60).cameras:
        alpha = render_meshes(scene, view).alpha
        assert not alpha[[0, -1]].any()
        assert not alpha[:, [0, -1]].any()
        assert alpha.any()


def test_many_meshes_are_as_one() -> None:
    whole = sphere()
    which = np.random.default_rng(0).integers(0, 50, len(whole.faces))
    parts = tuple(replace(whole, faces=whole.faces[which == part]) for part in range(50))
    np.testing.assert_array_equal(
        render_meshes(Meshes(parts), camera()).colour, render_meshes(Meshes((whole,)), camera()).colour
    )


@pytest.mark.parametrize("background", [None, (1.0, 1.0, 1.0)])
def test_nothing_in_view_is_the_background(background: tuple[float, float, float] | None) -> None:
    image = render_meshes(Meshes((square(z=9.0),)), straight_down(), background=background)
    assert not image.alpha.any()
    np.testing.assert_array_equal(image.colour, 0 if background is None else 1)
