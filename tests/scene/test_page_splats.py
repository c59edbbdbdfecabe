"""The splats of a page as whole numbers."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from nerfbake import PageSplats, build_page_splats
from nerfbake.errors import InvalidScene
from tests.support.splats import splats


@pytest.fixture(scope="module")
def page() -> PageSplats:
    return build_page_splats(splats(50, degree=1))


def test_a_splat_by_hand(page: PageSplats) -> None:
    one = PageSplats(
        np.array([[1, -2, 3]], np.int32),
        np.array([[640, 656, 624]], np.uint16),
        np.array([[2, 127, 127, 254]], np.uint8),
        np.array([51], np.uint8),
        np.array([[64, -32, 0]], np.int16),
        np.full((1, 3, 3), -16, np.int8),
        np.array([[10.0, 20, 30], [11, 21, 31]]),
        0.5,
        True,
        "z",
        np.zeros(3),
    ).restored()
    np.testing.assert_allclose(one.means, [[10.5, 19, 31.5]])
    np.testing.assert_allclose(one.scales, [[1, np.e, 1 / np.e]], rtol=1e-6)
    np.testing.assert_allclose(one.quats, [[0, 0, np.sqrt(0.5), np.sqrt(0.5)]], atol=1e-6)
    np.testing.assert_allclose(one.opacity, [0.2], rtol=1e-6)
    np.testing.assert_allclose(one.sh[0], [[1, -0.5, 0], *[[-0.5] * 3] * 3])
    assert (one.antialiased, one.up) == (True, "z")
    assert str(page) == "50 splats of SH degree 1"


def test_arrays_of_another_form_are_refused(page: PageSplats) -> None:
    cases: tuple[tuple[str, Any, str], ...] = (
        ("scales", page.scales.astype(np.int16), "page splats' scales has shape"),
        ("turns", page.turns[:, :3], "page splats' turns has shape"),
        ("rest", page.rest[:, :2], "with 3 coefficients"),
        ("places", page.places[:0], "are 0 with 4 coefficients"),
        ("scales", np.full_like(page.scales, 1024), "are too large"),
        ("turns", np.full_like(page.turns, 4), "are too large"),
    )
    for name, wrong, said in cases:
        with pytest.raises(InvalidScene, match=said):
            replace(page, **{name: wrong})
