"""The loss of splats: errors that were put in are found, in their units."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from nerfbake import Splats, measure_splats
from nerfbake.errors import InvalidScene
from tests.support.splats import splats


def plain(n: int = 5, **changes: Any) -> Splats:
    """Splats at the origin with unit scales, half opaque, grey."""
    zeros = np.zeros((n, 3), np.float32)
    turn = np.tile(np.array([1, 0, 0, 0], np.float32), (n, 1))
    scene = Splats(zeros, zeros + 1, turn, np.full(n, 0.5, np.float32), np.zeros((n, 4, 3), np.float32))
    return replace(scene, **changes)


def first(array: np.ndarray, row: Any) -> np.ndarray:
    """The array with another first row."""
    changed = array.copy()
    changed[0] = row
    return changed


def test_the_same_splats_have_no_loss() -> None:
    scene = splats(20, degree=3)
    loss = measure_splats(scene, replace(scene, quats=-scene.quats))
    assert loss.dropped_bands == 0
    assert all(error == (0, 0) for error in loss[:5])


def test_each_error_by_hand() -> None:
    before = plain()
    half = np.sqrt(np.float32(0.5))
    after = plain(
        means=first(before.means, [3, 0, 4]),
        scales=first(before.scales, [1, 1.5, 0.9]),
        quats=first(before.quats, [-half, 0, half, 0]),  # 90 degrees, and the sign of the opposite quaternion
        opacity=first(before.opacity, 0.25),
        sh=first(before.sh, [[0, 0, 0.2 / 0.28209479], [0] * 3, [0] * 3, [0] * 3]),
    )
    loss = measure_splats(before, after)
    for error, largest in zip(loss, (5, 0.5, 90, 0.25, 51), strict=False):
        assert isinstance(error, tuple)
        assert error == (pytest.approx(largest, rel=1e-5), 0)


def test_colours_are_compared_as_they_are_shown() -> None:
    """Coefficients that only make a colour brighter than white change nothing."""
    white, whiter = plain(), plain()
    white.sh[:, 0], whiter.sh[:, 0] = 3, 9
    assert measure_splats(white, whiter).colours == (0, 0)


def test_missing_bands_are_counted_and_seen_in_the_colours() -> None:
    scene = splats(20, degree=3)
    loss = measure_splats(scene, scene.with_degree(1))
    assert loss.dropped_bands == 2
    assert loss.colours.median > 10
    assert loss.means == (0, 0)


def test_other_rows_are_refused() -> None:
    with pytest.raises(InvalidScene, match="the second splats are 3; allowed: 4, as the first"):
        measure_splats(splats(4), splats(3))
