"""Sharp frames of a video."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from nerfbake.stages.sharpness import choose_sharpest, measure_sharpness


def test_sharpness_by_hand() -> None:
    # One white pixel: its own Laplacian is 4 * 255, that of its 4 neighbours -255, and 4 more are 0.
    grey = np.zeros((5, 5), np.uint8)
    grey[2, 2] = 255
    assert measure_sharpness(grey) == (16 + 4) * 255**2 / 9


def test_blur_lowers_sharpness() -> None:
    sharp = np.random.default_rng(0).integers(0, 256, (40, 60), np.uint8)
    values = [sharp]
    for _ in range(3):  # a shake of 2, 3 and 4 pixels
        values.append(((values[-1].astype(int) + np.roll(sharp, len(values), 1)) // 2).astype(np.uint8))
    found = [measure_sharpness(each) for each in values]
    assert found == sorted(found, reverse=True)
    assert measure_sharpness(np.full((40, 60), 200, np.uint8)) == 0


def test_the_sharpest_of_each_stretch() -> None:
    sharpness = [1.0, 5.0, 2.0, 7.0, 7.0, 3.0]
    frames = [(each, number) for number, each in enumerate(sharpness)]
    assert list(choose_sharpest(frames, total=6, count=2)) == [1, 3]
    assert list(choose_sharpest(frames, total=6, count=6)) == [0, 1, 2, 3, 4, 5]
    assert list(choose_sharpest(frames, total=3, count=3)) == [0, 1, 3]  # more than were announced
    assert list(choose_sharpest([], total=3, count=3)) == []


@given(st.lists(st.floats(0, 1e9), min_size=1, max_size=60), st.data())
def test_each_stretch_has_one_frame(sharpness: list[float], data: st.DataObject) -> None:
    total = len(sharpness)
    count = data.draw(st.integers(1, total))
    chosen = list(choose_sharpest(((each, i) for i, each in enumerate(sharpness)), total=total, count=count))
    assert [i * count // total for i in chosen] == list(range(count))
    assert max(sharpness) in [sharpness[i] for i in chosen]
