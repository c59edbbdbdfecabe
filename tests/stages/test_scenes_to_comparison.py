from __future__ import annotations

import json

import numpy as np
import pytest

from nerfbake import Image, build_field, build_octree, compare_scenes, orbit_cameras
from nerfbake.errors import BudgetMissed, InvalidScene
from nerfbake.scene.n3tree import N3Tree
from tests.support.scenes import n3tree


def scenes() -> tuple[N3Tree, N3Tree]:
    a = n3tree(splits=[(0, (1, 0, 1))], data_format="SH4", dtype=np.float32)
    b = n3tree(splits=[(0, (1, 0, 1))], data_format="SH4", dtype=np.float32)
    b.data[..., -1] += 0.5
    b.data[..., [0, 4, 8]] -= 0.25
    return a, b


def test_a_scene_against_itself_costs_nothing() -> None:
    a, _ = scenes()
    found = compare_scenes(a, build_octree(a), orbit_cameras(build_field(a), frames=3, width=20, height=16))
    assert found.means["a_b"]["psnr"] > 60
    assert found.means["a_b"]["ssim"] == pytest.approx(1, abs=1e-4)
    assert found.values == {name: {"mean": 0.0, "max": 0.0} for name in ("sigma", "dc", "higher")}
    found.require(min_psnr=60, max_error=0.01)


def test_what_was_changed_is_what_is_found() -> None:
    a, b = scenes()
    found = compare_scenes(a, b, orbit_cameras(build_field(a), frames=2, width=20, height=16))
    assert found.values["sigma"] == {"mean": 0.5, "max": 0.5}
    assert found.values["dc"] == {"mean": 0.25, "max": 0.25}
    assert found.values["higher"] == {"mean": 0.0, "max": 0.0}
    views = [view["a_b"] for view in found.views]
    assert found.means["a_b"]["psnr"] == pytest.approx(np.mean([view["psnr"] for view in views]))
    assert found.means["a_b"]["max_error"] == max(view["max_error"] for view in views)
    json.dumps([found.views, found.means, found.values], allow_nan=False)


def test_budgets() -> None:
    a, b = scenes()
    found = compare_scenes(a, b, orbit_cameras(build_field(a), width=20, height=16))
    psnr, error = found.means["a_b"]["psnr"], found.means["a_b"]["max_error"]
    found.require(min_psnr=psnr, max_error=error)
    with pytest.raises(BudgetMissed, match=r"mean PSNR of .* dB; allowed: `min_psnr=29.8"):
        found.require(min_psnr=psnr + 0.01)
    with pytest.raises(BudgetMissed, match=r"is off by .*; allowed: `max_error="):
        found.require(max_error=error - 0.001)


def test_the_error_against_the_truth_is_shown_too() -> None:
    a, b = scenes()
    cameras = orbit_cameras(build_field(a), width=120, height=60)
    black = np.zeros((60, 120, 3), np.float32)
    truth = [Image(black, np.ones((60, 120), np.float32), np.zeros((60, 120), np.float32))]
    found = compare_scenes(a, b, cameras, truth=truth)
    (row,) = found.rows()
    assert list(row) == ["truth", "a", "b", "a_b", "a_truth", "b_truth"]
    for name, one, other in (("a_b", "a", "b"), ("a_truth", "a", "truth"), ("b_truth", "b", "truth")):
        expected = np.minimum(8 * np.abs(row[one].colour - row[other].colour), 1)
        np.testing.assert_array_equal(row[name].colour, expected)
    assert list(next(compare_scenes(a, b, cameras).rows())) == ["a", "b", "a_b"]
    # Each column has a title of its own, in black on white.
    strip = found.sheet.colour[: -60 - 1, :, 0]
    inked = [(strip[:, i * 124 : i * 124 + 120] == 0).sum() for i in range(6)]
    assert len({strip[:, i * 124 : i * 124 + 120].tobytes() for i in range(6)}) == 6
    assert min(inked) > 10


def test_a_truth_and_the_sheet() -> None:
    a, b = scenes()
    cameras = orbit_cameras(build_field(a), frames=2, width=20, height=16)
    clear = np.zeros((16, 20), np.float32)
    truth = [Image(np.zeros((16, 20, 3), np.float32), clear, clear, None)] * 2
    found = compare_scenes(a, b, cameras, truth=truth)
    assert set(found.views[0]) == {"name", "a_b", "a_truth", "b_truth"}
    titles = 2 * 4 + 7
    assert found.sheet.size == (6 * 24 - 4, titles + 2 * 20 - 4)
    # The truth, transparent everywhere, counts as white.
    assert found.sheet.colour[titles, 0].tolist() == [1, 1, 1]
    with pytest.raises(InvalidScene, match="truth has 1 pictures; allowed: 2"):
        compare_scenes(a, b, cameras, truth=truth[:1])
    with pytest.raises(InvalidScene, match="truth of 0000 has 20x16 pixels; allowed: 30x30"):
        compare_scenes(a, b, orbit_cameras(build_field(a), frames=2, width=30, height=30), truth=truth)


def test_pictures_that_are_known_are_not_rendered_again() -> None:
    a, b = n3tree(splits=[(0, (1, 0, 1))]), n3tree(splits=[(0, (1, 0, 1))])
    b.data[..., -1] += 0.5
    cameras = orbit_cameras(build_field(a), frames=2, width=12, height=10)
    whole = compare_scenes(a, b, cameras)
    shown = [picture for _, picture, _ in whole.pictures]
    # The scene in place of `a` is not looked at.
    assert compare_scenes(b, b, cameras, pictures_of_a=shown).views == whole.views
    with pytest.raises(InvalidScene, match="the pictures of a are 1; allowed: 2, one a camera"):
        compare_scenes(a, b, cameras, pictures_of_a=shown[:1])
