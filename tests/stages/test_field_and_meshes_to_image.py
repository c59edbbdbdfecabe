"""A field and opaque triangles in one picture, against what the law of absorption says."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from nerfbake import Meshes, render_field, render_field_and_meshes, render_meshes
from nerfbake.errors import InvalidScene
from tests.support.fields import front, solid
from tests.support.meshes import mesh

BLUE = np.tile(np.array([0, 0, 1], np.float32), (4, 1))


def wall(y: float, half: float = 5.0, x: float = 0.5) -> Meshes:
    """A blue square across the view of front(), at this y."""
    corners = [[x - half, y, -5], [x + half, y, -5], [x + half, y, 5], [x - half, y, 5]]
    return Meshes((mesh(corners, [[0, 1, 2], [0, 2, 3]], colours=BLUE),))


@pytest.mark.parametrize("sigma", [0.1, 1.0, 30.0])
@pytest.mark.parametrize("y", [0.25, 0.8])
def test_a_ray_ends_at_the_mesh(sigma: float, y: float) -> None:
    # The field fills 0 <= y <= 1, the camera stands at y = -2.5 and looks along +y.
    image = render_field_and_meshes(solid(sigma, red=2), wall(y), front(), transmittance_cut=0)
    alpha = 1 - np.exp(-sigma * y)
    red = alpha / (1 + np.exp(-2))
    assert_allclose(image.colour[2, 2], [red, 0.5 * alpha, 0.5 * alpha + 1 - alpha], rtol=1e-4)
    assert_allclose(image.alpha, 1, atol=1e-6)
    # What is lost before the wall is lost at the mean of an exponential cut off there, all else at the wall.
    mean = 1 / sigma - y * np.exp(-sigma * y) / alpha
    assert_allclose(image.depth[2, 2], alpha * (2.5 + mean) + (1 - alpha) * (2.5 + y), rtol=1e-4)


def test_a_mesh_in_front_hides_the_field_and_one_behind_shines_through() -> None:
    field = solid(1.0, red=2)
    for how in ("stop", "ztest"):
        options: Any = {"how": how, "transmittance_cut": 0}
        before = render_field_and_meshes(field, wall(-1.0), front(), **options)
        assert_array_equal(before.colour, render_meshes(wall(-1.0), front()).colour)
        assert_allclose(before.depth[2, 2], 1.5, rtol=1e-6)
        alone, behind = (
            render_field(field, front(), background=None),
            render_field_and_meshes(field, wall(3.0), front(), **options),
        )
        expected = alone.colour[2, 2] + (1 - alone.alpha[2, 2]) * np.array([0, 0, 1])
        assert_allclose(behind.colour[2, 2], expected, atol=1e-4)


def test_the_cheap_test_takes_all_of_the_field_or_nothing() -> None:
    # The field's own expected depth is 2.5 + 0.418: a wall before that hides it, one behind it is behind all of it.
    field = solid(1.0, red=2)
    alone = render_field(field, front(), background=None, transmittance_cut=0)
    assert_allclose(alone.depth[2, 2], 2.5 + 0.418, atol=1e-3)
    hidden = render_field_and_meshes(field, wall(0.40), front(), how="ztest", transmittance_cut=0)
    assert_allclose(hidden.colour[2, 2], [0, 0, 1], atol=2e-2)
    laid = render_field_and_meshes(field, wall(0.43), front(), how="ztest", transmittance_cut=0)
    assert_allclose(laid.colour[2, 2, 0], alone.colour[2, 2, 0], atol=1e-6)
    assert_allclose(laid.alpha[2, 2], 1, atol=1e-6)
    exact = render_field_and_meshes(field, wall(0.43), front(), transmittance_cut=0)
    assert exact.colour[2, 2, 0] < 0.6 * laid.colour[2, 2, 0]


def test_beside_the_mesh_the_picture_is_the_fields() -> None:
    field, half = solid(1.0, red=2), wall(0.5, half=0.5, x=1.0)  # covers x from 0.5: the picture's right half
    alone = render_field(field, front(6), background=None)
    for how in ("stop", "ztest"):
        options: Any = {"how": how, "background": None}
        both = render_field_and_meshes(field, half, front(6), **options)
        assert_allclose(both.colour[:, :3], alone.colour[:, :3], atol=1e-6)
        assert_allclose(both.alpha[:, :3], alone.alpha[:, :3], atol=1e-6)
        assert_allclose(both.depth[:, :3], alone.depth[:, :3], rtol=1e-6)
        assert (both.alpha[2:4, 3] > 0.999).all()
        assert both.background is None
        black = render_field_and_meshes(field, half, front(6), **{**options, "background": (0.0, 0.0, 0.0)})
        assert_allclose(black.colour, both.colour, atol=1e-6)


def test_there_are_two_ways() -> None:
    wrong: Any = "blend"
    with pytest.raises(InvalidScene, match="composite is 'blend'; allowed: stop, ztest"):
        render_field_and_meshes(solid(1.0), wall(0.5), front(), how=wrong)
