"""Which pixels show the sky, and what they say about cells."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from nerfbake import Camera, Cameras
from nerfbake.kernels.arrays import Floats, Singles
from nerfbake.stages._depth_map import DepthMap
from nerfbake.stages._ray_targets import reduced_view
from nerfbake.stages._scenery_depths import vote
from nerfbake.stages._scenery_sky import distance_within, find_sky, upward
from tests.support.yards import yard

UP = np.array([0.0, 1, 0])
BLUE, WARM, STONE = (0.4, 0.6, 0.9), (0.9, 0.8, 0.7), (0.6, 0.5, 0.4)


def ahead(edge: int = 32) -> Camera:
    return Camera(edge, edge, float(edge), np.eye(4), "ahead")


def picture(upper: tuple[float, ...], lower: tuple[float, ...] = STONE, *, rows: int = 12, edge: int = 32) -> Singles:
    """The first rows have one colour, the others have another one."""
    image = np.ones((edge, edge, 4), np.float32)
    image[:rows, :, :3], image[rows:, :, :3] = upper, lower
    return image


def test_the_sky_of_a_yard_is_found() -> None:
    views, skies = yard(frames=3, width=72, height=48, samples=1)
    up = upward(views.cameras)
    assert up is not None
    assert up[2] > 0.9
    for number, sky in enumerate(skies):
        found = find_sky(*reduced_view(views, number, 1), up)
        assert sky.mean() > 0.2
        assert (found & ~sky).mean() < 0.02
        assert (sky & ~found).mean() < 0.03


def test_the_sky_ends_at_an_edge() -> None:
    expected = np.zeros((32, 32), bool)
    expected[:12] = True
    assert_array_equal(find_sky(ahead(), picture(BLUE), UP), expected)


@pytest.mark.parametrize(
    "image",
    [
        picture(WARM),  # a ceiling in the light of lamps
        picture((0.1, 0.1, 0.1)),
        picture(BLUE, BLUE),  # a plain wall, or the ground from above
        picture(BLUE, rows=1),
        np.random.default_rng(0).uniform(0.3, 0.9, (32, 32, 4)) + np.array([0, 0, 0, 1]),  # leaves
    ],
)
def test_what_is_no_sky(image: Singles) -> None:
    assert not find_sky(ahead(), image.astype(np.float32), UP).any()


def test_a_picture_that_is_held_sideways_has_its_sky_at_the_side() -> None:
    sideways = np.eye(4)
    sideways[:3, :3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]  # its right side is up
    camera = replace(ahead(), pose=sideways)
    found = find_sky(camera, np.ascontiguousarray(np.rot90(picture(BLUE), -1)), UP)
    assert found[:, -12:].all()
    assert not found[:, :-12].any()


def test_photographs_from_above_have_no_common_up() -> None:
    def turned(angle: float) -> Camera:
        pose = np.eye(4)
        pose[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
        return replace(ahead(), pose=pose)

    assert upward(Cameras(tuple(turned(0.5 * np.pi * i) for i in range(4)))) is None
    found = upward(Cameras(tuple(turned(0.1 * i) for i in (-1, 0, 1))))
    assert found is not None
    assert_allclose(found, UP, atol=1e-12)


def test_distances_within_the_sky() -> None:
    sky = np.zeros((9, 9), bool)
    sky[1:8, 1:8] = True
    found = distance_within(sky, np.zeros((9, 9), bool))
    assert found[4, 4] == pytest.approx(4 / np.sqrt(2))
    assert found[1, 4] == pytest.approx(1 / np.sqrt(2))
    assert_array_equal(found > 0, sky)


def test_a_sky_with_depths_is_no_sky() -> None:
    sky = np.ones((40, 40), bool)
    sky[0] = False
    assert distance_within(sky, np.zeros_like(sky)).max() > 4
    assert not distance_within(sky, sky).any()


@pytest.mark.parametrize(
    ("centre", "width", "empty"), [((0, 0, -5), 0.5, True), ((0, 0, -5), 9, False), ((9, 0, -5), 0.5, False)]
)
def test_cells_before_the_sky_are_empty(centre: Floats, width: float, empty: bool) -> None:
    distance = np.full((32, 32), 12, np.float32)
    seen = DepthMap(ahead(), np.full((32, 32), -np.inf), np.zeros((32, 32), bool), 0.01, distance)
    votes = vote([seen], np.array([centre], np.float64), np.full(1, width))
    assert votes.empty[0] == empty
    assert not votes.surface[0]
