"""Splats: what their arrays must be, and which rows of a file are left out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from nerfbake.errors import InvalidScene
from nerfbake.scene.splats import splats_of_rows
from tests.support.splats import splats


def test_random_splats_are_sound_at_every_degree() -> None:
    for degree in range(5):
        scene = splats(3, degree=degree)
        assert (scene.n, scene.degree, scene.B) == (3, degree, (degree + 1) ** 2)
        assert not scene.problems()


def test_wrong_shapes_are_refused() -> None:
    scene = splats(3, degree=1)
    for change in (
        {"means": scene.means[:2]},
        {"scales": scene.scales.astype(np.float64)},
        {"quats": scene.quats[:, :3]},
        {"sh": scene.sh[:, :3]},
        {"sh": scene.sh[:, 0]},
    ):
        with pytest.raises(InvalidScene, match="allowed"):
            replace(scene, **change)


@pytest.mark.parametrize(
    ("name", "value", "told"),
    [
        ("means", np.nan, "means[1, 0] is nan"),
        ("scales", -1, "scales[1, 0] is -1"),
        ("quats", 2, "quats' lengths[1] is"),
        ("opacity", 1.5, "opacity[1] is 1.5"),
        ("sh", np.inf, "sh[1, 0, 0] is inf"),
    ],
)
def test_a_value_that_cannot_be_drawn_is_named(name: str, value: float, told: str) -> None:
    scene = splats(3)
    getattr(scene, name)[1] = value
    assert str(scene.problems()[0]).startswith(told)


def test_rows_that_cannot_be_drawn_are_left_out_and_counted() -> None:
    scene = splats(9)
    arrays = [
        np.array(array, np.float64) for array in (scene.means, scene.scales, scene.quats, scene.opacity, scene.sh)
    ]
    arrays[2] *= 3  # quaternions of any length
    arrays[0][1, 2], arrays[1][3, 0], arrays[2][5], arrays[4][7, 2, 1] = np.nan, 1e38, 0, np.inf
    found = splats_of_rows(*arrays)
    assert found.dropped == 4
    assert np.array_equal(found.means, scene.means[[0, 2, 4, 6, 8]])
    assert np.allclose(found.quats, scene.quats[[0, 2, 4, 6, 8]], atol=1e-7)
    assert str(found.problems()[0]).startswith("the file had 4 rows that cannot be drawn")
    arrays[3][8] = 2
    with pytest.raises(InvalidScene, match="have 5 rows of 9 that cannot be drawn; allowed: at most half"):
        splats_of_rows(*arrays)
