"""Colours as Morton codes."""

from __future__ import annotations

import numpy as np

from nerfbake.kernels.cluster import colours


def test_codes_by_hand() -> None:
    for colour, code in (((1, 0, 0), 4), ((0, 1, 0), 2), ((0, 0, 1), 1), ((2, 0, 0), 32), ((255, 255, 255), 2**24 - 1)):
        assert colours.codes_of(np.array([colour], np.uint8)).tolist() == [code]


def test_every_code_is_one_colour() -> None:
    codes = np.arange(0, colours.CODES, 7, dtype=np.uint32)
    np.testing.assert_array_equal(colours.codes_of(colours.colours_of(codes)), codes)


def test_runs_of_equal_values() -> None:
    assert colours.runs(np.array([3, 3, 5, 9, 9])).tolist() == [0, 2, 3, 5]
