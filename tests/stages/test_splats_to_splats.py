"""Fewer splats: two equal ones become one with the same picture, and what is cut is told by its centre and company."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from nerfbake import Camera, Splats, cut_floaters, cut_largest_part, fit_splats, merge_splats, render_splats
from nerfbake.errors import InvalidScene
from nerfbake.jobs.photographs import render_split
from nerfbake.kernels import parallel
from tests.support.splats import splats

ARRAYS = ("means", "scales", "quats", "opacity", "sh")


def rows(scene: Splats, which: object) -> Splats:
    changes: dict[str, Any] = {name: getattr(scene, name)[which] for name in ARRAYS}
    return replace(scene, **changes)


def sheet(n: int, *, at: tuple[float, float, float] = (0, 0, 0), seed: int = 0) -> Splats:
    """Opaque splats on a square of edge 1."""
    made = splats(n, degree=0, seed=seed)
    places = np.random.default_rng(seed).uniform(-0.5, 0.5, (n, 3)) * [1, 1, 0.01] + at
    return replace(
        made,
        means=places.astype(np.float32),
        scales=np.full((n, 3), 0.01, np.float32),
        opacity=np.full(n, 0.9, np.float32),
    )


def joined(*parts: Splats) -> Splats:
    changes: dict[str, Any] = {name: np.concatenate([getattr(part, name) for part in parts]) for name in ARRAYS}
    return replace(parts[0], **changes)


@pytest.mark.parametrize("antialiased", [False, True])
def test_two_equal_splats_become_one_with_the_same_picture(antialiased: bool) -> None:
    one = rows(splats(3, degree=2, antialiased=antialiased), [1])
    one = replace(one, means=np.array([[0, 0, -5]], np.float32), scales=np.array([[0.5, 0.9, 0.7]], np.float32))
    one = replace(one, opacity=np.full(1, 0.1, np.float32))
    two = rows(one, [0, 0])
    merged = merge_splats(two, count=1)
    assert merged.n == 1
    assert merged.opacity[0] == pytest.approx(0.2 - 0.1**2 / 2)  # what both cover counts once
    assert_allclose(merged.means, one.means)
    assert_allclose(np.sort(merged.scales), np.sort(one.scales), rtol=1e-5)
    assert_allclose(merged.sh, one.sh, rtol=1e-6)
    camera = Camera(48, 48, 60.0, np.eye(4))
    before, after = (render_splats(scene, camera).colour for scene in (two, merged))
    assert np.abs(before - after).max() < 2 / 255
    assert np.abs(before - 1).max() > 0.05


def test_a_count_above_their_number_changes_nothing() -> None:
    scene = splats(5)
    assert merge_splats(scene, count=5) is scene
    assert merge_splats(scene, count=6) is scene


@given(st.integers(2, 60), st.integers(1, 60), st.integers(0, 1000))
def test_there_are_as_many_as_wanted_and_all_can_be_drawn(n: int, count: int, seed: int) -> None:
    scene = splats(n, degree=1, seed=seed)
    merged = merge_splats(scene, count=count)
    assert merged.n == min(n, count)
    assert not merged.value_problems()
    assert merged.B == scene.B
    # Merged splats lie between the others.
    assert (merged.means >= scene.means.min(axis=0) - 1e-5).all()
    assert (merged.means <= scene.means.max(axis=0) + 1e-5).all()


def test_what_is_not_merged_keeps_its_bytes_and_its_place() -> None:
    pair = rows(sheet(1), [0, 0])
    scene = joined(sheet(1, at=(5, 0, 0)), pair, sheet(1, at=(0, 7, 0), seed=1), sheet(1, at=(0, 0, 9), seed=2))
    merged = merge_splats(scene, count=4)
    for name in ARRAYS:
        assert_array_equal(getattr(merged, name)[[0, 2, 3]], getattr(scene, name)[[0, 3, 4]])


def test_all_equal_splats_can_be_merged() -> None:
    assert merge_splats(rows(sheet(1), [0] * 40), count=3).n == 3


def test_the_origin_and_the_up_axis_stay() -> None:
    scene = replace(splats(60), origin=np.array([5e6, 1.0, 0.25]), up="z")
    merged = merge_splats(scene, count=20)
    assert_array_equal(merged.origin, scene.origin)
    assert merged.up == "z"
    views = render_split(scene, frames=2, edge=16).training
    *_, state = fit_splats(merged, views, epochs=1)
    assert_array_equal(state.splats().origin, scene.origin)
    assert state.splats().up == "z"


@pytest.mark.parametrize("change", [merge_splats, cut_floaters, cut_largest_part])
def test_the_bytes_do_not_depend_on_the_threads(change: object, monkeypatch: pytest.MonkeyPatch) -> None:
    scene, made = splats(400), []
    for threads in (1, 2, 3):
        monkeypatch.setattr(parallel, "cores", lambda threads=threads: threads)
        options = {"count": 90} if change is merge_splats else {}
        made.append(change(scene, **options))  # type: ignore[operator]
    for name in ARRAYS:
        assert getattr(made[0], name).tobytes() == getattr(made[1], name).tobytes() == getattr(made[2], name).tobytes()


def test_merged_splats_look_more_like_the_original_than_some_of_it() -> None:
    scene = sheet(600)
    scene = replace(scene, scales=np.full((600, 3), 0.03, np.float32), sh=np.zeros_like(scene.sh))
    scene.sh[:, 0, 0] = 3 * scene.means[:, 0]
    pose = np.eye(4)
    pose[2, 3] = 2
    camera = Camera(64, 64, 90.0, pose)
    truth, merged, some = (
        render_splats(each, camera).colour for each in (scene, merge_splats(scene, count=200), rows(scene, slice(200)))
    )
    assert ((merged - truth) ** 2).mean() < 0.2 * ((some - truth) ** 2).mean()


def test_floaters_by_hand() -> None:
    wall, lonely = sheet(900), sheet(1, at=(0, 0, 1.2), seed=1)
    cloud = replace(sheet(8, at=(0.2, 0.2, 0.9), seed=2), opacity=np.full(8, 0.05, np.float32))
    huge = replace(sheet(4, at=(9, 9, 9), seed=3), scales=np.full((4, 3), 3.0, np.float32))
    kept = cut_floaters(joined(lonely, wall, cloud, huge))
    assert kept.n == 900
    assert_array_equal(kept.means, wall.means)
    assert cut_floaters(wall) is wall
    # The same huge splats inside, as fog, and thin ones at the wall stay.
    thin = replace(sheet(5, seed=4), opacity=np.full(5, 0.01, np.float32))
    fog = replace(sheet(2, seed=5), scales=np.full((2, 3), 3.0, np.float32))
    assert cut_floaters(joined(wall, thin, fog)).n == 907


def test_the_largest_part_by_hand() -> None:
    small, large = sheet(300), sheet(500, at=(2, 0, 0), seed=1)
    haze = replace(sheet(3, at=(2, 0, 0), seed=2), opacity=np.full(3, 0.02, np.float32))
    away = replace(sheet(3, at=(0, 3, 0), seed=2), opacity=np.full(3, 0.02, np.float32))
    kept = cut_largest_part(joined(small, haze, large, away))
    assert_array_equal(kept.means, np.concatenate([haze.means, large.means]))
    # A bridge of opaque splats connects both; a thin one does not.
    bridge = sheet(100, seed=3)
    bridge.means[:] = np.linspace([0.4, 0, 0], [1.6, 0, 0], 100)
    assert cut_largest_part(joined(small, large, bridge)).n == 900
    thin = replace(bridge, opacity=np.full(100, 0.05, np.float32))
    assert cut_largest_part(joined(small, large, thin)).n < 620


def test_what_cannot_be_done_is_named() -> None:
    with pytest.raises(InvalidScene, match="count is 0; allowed: 1 or more"):
        merge_splats(splats(3), count=0)
    with pytest.raises(InvalidScene, match="the splats are all floaters"):
        cut_floaters(splats(1))
    with pytest.raises(InvalidScene, match=r"the splats have opacities below 0\.1"):
        cut_largest_part(replace(splats(3), opacity=np.full(3, 0.05, np.float32)))
