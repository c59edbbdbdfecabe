"""Colours at vertices: what the texture has there, by hand, and for every vertex of a torus."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from nerfbake import colour_vertices, sample_stage1
from nerfbake.errors import InvalidScene
from nerfbake.kernels.surface.texture import bilinear
from tests.support.meshes import cube, mesh


def test_a_seam_gets_the_mean_of_its_two_colours() -> None:
    # Two triangles with a common edge, whose ends have their own texels on each side.
    places = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]]
    middles = [[(2 * k + 1) / 12, 0.5] for k in range(6)]
    texture = np.array([[[0, 0, 0], [100, 0, 0], [0, 200, 0], [50, 0, 0], [0, 0, 255], [255, 255, 255]]], np.uint8)
    found = colour_vertices(mesh(places, [[0, 1, 2], [4, 3, 5]], uvs=middles, texture=texture))
    assert (found.uvs, found.texture) == (None, None)
    corners = {
        tuple(place): colour for place, colour in zip(found.positions.tolist(), np.array(found.colours), strict=True)
    }
    assert len(corners) == 4
    np.testing.assert_allclose(corners[1, 0, 0], [75 / 255, 0, 0], atol=1e-6)
    np.testing.assert_allclose(corners[0, 1, 0], [0, 100 / 255, 0.5], atol=1e-6)
    np.testing.assert_array_equal(found.positions[found.faces], np.array(places, np.float32)[[[0, 1, 2], [4, 3, 5]]])


def test_every_vertex_has_the_colour_of_its_texture() -> None:
    (torus,) = sample_stage1(resolution=64).meshes
    assert torus is not None
    assert torus.texture is not None
    found = colour_vertices(torus)
    wanted = bilinear(torus.texture, torus.require_uvs())[torus.faces]
    colours = np.array(found.colours)[found.faces]
    seams = np.abs(colours - wanted).max(axis=2) > 1e-6
    assert seams.mean() < 0.1  # only along the two seams of the torus
    np.testing.assert_array_equal(found.positions[found.faces], torus.positions[torus.faces])


def test_without_a_texture_there_are_no_colours() -> None:
    with pytest.raises(InvalidScene, match="the mesh has no texture"):
        colour_vertices(replace(cube(), colours=None))
