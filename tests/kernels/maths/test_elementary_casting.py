from __future__ import annotations

import warnings

import numpy as np

from nerfbake.kernels.maths.elementary import cast


def test_what_cannot_be_is_kept_without_a_word() -> None:
    signalling = np.array([0x7FA00000, 0x3F800000], np.uint32).view(np.float32)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        wide = cast(signalling, np.float64)
        narrow = cast(np.array([1e300, -1e300, np.nan, 2]), np.float32)
    np.testing.assert_array_equal(wide, [np.nan, 1])
    np.testing.assert_array_equal(narrow, [np.inf, -np.inf, np.nan, 2])


def test_the_same_type_is_the_same_array() -> None:
    values = np.ones(3, np.float32)
    assert cast(values, np.float32) is values
