from __future__ import annotations

import numpy as np
import pytest

from nerfbake.scene.origin import choose_origin, lost_origin, relative_to

UTM = np.array([453000.125, 5012345.5, 120.25])
CORNERS = np.array([[0, 0, 0], [1.7, 0, 0], [0, 1.3, 0.1]])


def test_a_scene_of_a_map_gets_its_rounded_centre_and_loses_less_than_a_micrometre() -> None:
    origin = choose_origin([CORNERS + UTM])
    assert origin.tolist() == [453001.0, 5012346.0, 120.0]  # the middle is 453000.975, 5012346.15, 120.3
    near = relative_to(CORNERS + UTM, origin)
    assert near.dtype == np.float32
    assert np.abs(near + origin - (CORNERS + UTM)).max() < 1e-6


@pytest.mark.parametrize(
    "places",
    [
        CORNERS,
        CORNERS * 3 + 200,  # 5 wide: float32 holds it to a 600,000th of that
        (CORNERS + UTM).astype(np.float32),  # no digits to lose
        (CORNERS + UTM).astype(np.float32).astype(np.float64),
        np.full((3, 3), 0.1),
        np.empty((0, 3)),
        np.full((3, 3), np.nan),
        np.full((2, 3), 1e300),
    ],
)
def test_all_other_files_have_no_origin(places: np.ndarray) -> None:
    assert choose_origin([places]).tolist() == [0, 0, 0]


def test_points_far_outside_and_invalid_ones_do_not_count() -> None:
    random = np.random.default_rng(0)
    crowd = random.normal(size=(1000, 3)) + UTM
    crowd[:5] = [0, 0, 0]
    crowd[5] = np.inf
    crowd[6] = 1e9
    assert np.abs(choose_origin([crowd]) - UTM).max() < 2


@pytest.mark.parametrize("extent", [0.003, 2, 2000, 20000])
def test_a_millimetre_in_20_km_and_a_digit_of_any_extent_are_kept(extent: float) -> None:
    places = np.random.default_rng(1).uniform(-extent / 2, extent / 2, (500, 3)) + UTM
    origin = choose_origin([places[:200], places[200:]])
    found = relative_to(places, origin) + origin
    assert np.abs(found - places).max() < min(1e-3, extent / 1e5)
    # A decimal number, as short as the extent allows.
    assert [round(value, 3) for value in origin.tolist()] == origin.tolist()


def test_one_point_has_an_origin_if_it_is_on_a_map() -> None:
    assert choose_origin([UTM[None] + 1 / 3]).tolist() == [453000.0, 5012346.0, 121.0]


def test_the_note_has_all_digits() -> None:
    told = lost_origin(np.array([453000.0, 5012345.125, 0.001]), ".spz")
    assert told == "positions are relative to the origin 453000 5012345.125 0.001, which .spz cannot keep"
