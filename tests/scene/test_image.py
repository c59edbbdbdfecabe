from __future__ import annotations

import numpy as np
import pytest

from nerfbake import Image
from nerfbake.scene.image import GAP

Colour = tuple[float, float, float]


def plain(value: float, width: int = 3, height: int = 2, background: Colour | None = (1.0, 1.0, 1.0)) -> Image:
    alpha = np.full((height, width), 0.5, np.float32)
    return Image(np.full((height, width, 3), value, np.float32), alpha, np.zeros_like(alpha), background)


def test_a_sheet_of_three_in_two_columns_by_hand() -> None:
    sheet = Image.tiled([plain(0.1), plain(0.2), plain(0.3)], columns=2)
    assert GAP == 4
    assert sheet.size == (3 + 4 + 3, 2 + 4 + 2)
    expected = np.ones((8, 10), np.float32)
    expected[0:2, 0:3] = 0.1
    expected[0:2, 7:10] = 0.2
    expected[6:8, 0:3] = 0.3
    assert (sheet.colour == expected[..., None]).all()
    assert ((sheet.alpha == 0.5) == (expected < 1)).all()


def test_cells_are_as_large_as_the_largest() -> None:
    sheet = Image.tiled([plain(0.1, 5, 1), plain(0.2, 2, 7)], columns=2)
    assert sheet.size == (5 + 4 + 5, 7)
    assert (sheet.colour[:7, 9:11] == np.float32(0.2)).all()
    assert (sheet.colour[1:, :5] == 1).all()


@pytest.mark.parametrize(
    ("count", "size", "columns", "rows"),
    [
        (1, (9, 9), 1, 1),
        (2, (9, 9), 2, 1),
        (4, (9, 9), 2, 2),
        (36, (9, 9), 6, 6),
        (8, (16, 4), 2, 4),
        (4, (2, 90), 4, 1),
    ],
)
def test_without_columns_the_sheet_is_nearly_square(count: int, size: tuple[int, int], columns: int, rows: int) -> None:
    sheet = Image.tiled([plain(0.5, *size)] * count)
    assert sheet.size == (columns * (size[0] + GAP) - GAP, rows * (size[1] + GAP) - GAP)


def test_the_first_background_or_none_shows_between() -> None:
    clear = plain(0.25, background=None)
    assert Image.tiled([clear, clear]).pixels[0, 3].tolist() == [0, 0, 0, 0]
    mixed = Image.tiled([plain(0.0, background=(1.0, 0.0, 0.0)), clear], columns=2)
    assert mixed.pixels[0, 3].tolist() == [255, 0, 0]
    assert mixed.colour[0, 7].tolist() == [0.75, 0.25, 0.25]


def test_a_reduced_picture_has_the_means_of_its_pixels() -> None:
    colour = np.arange(5 * 4 * 3, dtype=np.float32).reshape(5, 4, 3)
    alpha = np.arange(20, dtype=np.float32).reshape(5, 4)
    small = Image(colour, alpha, np.ones_like(alpha), None).reduced(2)
    assert small.size == (2, 2)
    assert small.background is None
    np.testing.assert_allclose(small.colour[1, 0], colour[2:4, :2].mean(axis=(0, 1)), rtol=1e-6)
    np.testing.assert_allclose(small.alpha, [[2.5, 4.5], [10.5, 12.5]], rtol=1e-6)
