"""The distances that pixels show, from the depths of a smaller picture."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from nerfbake import fit_field
from nerfbake.scene.lens import Lens
from nerfbake.scene.schedule import parse_schedule
from nerfbake.stages._depth_map import DepthMap, surface_distances
from nerfbake.stages._fit_state import FitState
from nerfbake.stages._scenery_depths import find_depths
from tests.stages.test_scenery_depths import HEIGHT, above


@pytest.mark.parametrize("lens", [None, Lens("polynomial", (-0.2,)), Lens("fisheye", (0.05,))])
def test_distances_are_those_along_the_rays(lens: Lens | None) -> None:
    views = above(lens)
    for number, found in find_depths(views, HEIGHT).maps.items():
        camera = views.cameras.cameras[number]
        distances = surface_distances(found, camera)
        eye, looks = camera.rays()
        exact = (-eye[2] / looks[:, 2]).reshape(distances.shape)
        known = distances > 0
        assert known.mean() > 0.6
        assert np.quantile(np.abs(distances[known] / exact[known] - 1), 0.98) < 0.02


def test_unknown_depths_the_sky_and_what_a_map_does_not_show_have_no_distance() -> None:
    camera = replace(above().cameras.cameras[0], lens=None)
    inverse, known = np.full((8, 8), 0.5), np.ones((8, 8), bool)
    known[:, 0], inverse[:, 1], inverse[:, 2] = False, -np.inf, 0.0
    half = replace(camera, width=8, height=8, focal=(8.0, 8.0), centre=(4.0, 4.0))
    seen = replace(half, width=16, height=8, focal=(8.0, 8.0), centre=(4.0, 4.0))
    distances = surface_distances(DepthMap(half, inverse, known, 0.1, np.zeros((8, 8), np.float32)), seen)
    assert_array_equal(distances[:, :3], 0)
    assert_array_equal(distances[:, 8:], 0)
    x, y = np.meshgrid((np.arange(3, 8) + 0.5 - 4) / 8, (np.arange(8) + 0.5 - 4) / 8)
    assert_allclose(distances[:, 3:8], 2 * np.sqrt(1 + x * x + y * y), rtol=1e-6)


def test_a_fit_with_depths_resumes_with_the_same_bytes() -> None:
    views = above().take(range(4))
    short = parse_schedule("cells=32,scale=4,epochs=1,density=0.05/cells=32,scale=4,epochs=1,split=0.3")
    states, half = fit_field(views, schedule=short, basis="SH1"), None
    for number, whole in enumerate(states):
        assert whole.depths is not None
        assert whole.depths.maps
        if number == 5:
            half = {name: array.copy() for name, array in whole.arrays().items()}
    assert half is not None
    *_, resumed = fit_field(views, schedule=short, start=FitState.of_arrays(half))
    for name, array in whole.arrays().items():
        assert_array_equal(resumed.arrays()[name], array, err_msg=name)
