"""Colours as Morton codes."""

from __future__ import annotations

import numpy as np

from nerfbake.kernels.cluster.colours import CODES, codes_of, colours_of, runs


def test_codes_by_hand() -> None:
    for colour, code in (((1, 0, 0), 4), ((0, 1, 0), 2), ((0, 0, 1), 1), ((2, 0, 0), 32), ((255, 255, 255), 2**24 - 1)):
        assert codes_of(np.array([colour], np.uint8)).tolist() == [code]


def test_every_code_is_one_colour() -> None:
    codes = np.arange(0, CODES, 7, dtype=np.uint32)
    np.testing.assert_array_equal(codes_of(colours_of(codes)), codes)


def test_runs_of_equal_values() -> None:
    assert runs(np.array([3, 3, 5, 9, 9])).tolist() == [0, 2, 3, 5]
