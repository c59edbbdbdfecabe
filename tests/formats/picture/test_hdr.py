"""Environment maps from Radiance pictures."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from nerfbake.errors import InvalidFile, MemoryLimit
from nerfbake.formats.picture import hdr
from nerfbake.memory import memory_limit
from tests.support.environments import HEAD, flat, pixels, runs


def radiance(data: bytes) -> np.ndarray:
    return hdr.decode(memoryview(data)).radiance


def test_a_pixel_by_hand() -> None:
    # (200, 130, 140) 2^(129 - 136): 1.5625, 1.015625, 1.09375. Exponent 0 is black.
    found = radiance(flat())
    assert_array_equal(found[1, 0], np.array([1.5625, 1.015625, 1.09375], np.float32))
    assert_array_equal(found[0, 0], 0)
    assert found.dtype == np.float32


def test_runs_and_flat_rows_are_the_same_pixels() -> None:
    coded = pixels().astype(np.float64)
    assert_array_equal(radiance(flat()), (coded[..., :3] * 2 ** (coded[..., 3:] - 136)).astype(np.float32))
    assert_array_equal(radiance(runs()), radiance(flat()))
    assert hdr.recognise(memoryview(runs()))


def test_exposures_are_divided_out() -> None:
    twice = flat().replace(b"\n\n", b"\nEXPOSURE=2\nEXPOSURE= 4\n\n", 1)
    assert_array_equal(radiance(twice) * 8, radiance(flat()))


def test_headers_of_the_inputs_that_pcomb_keeps_have_no_effect() -> None:
    kept = b"\na.hdr:\n\trpict -vf a.vf\n\tEXPOSURE=2\n\tFORMAT=32-bit_rle_xyze\npcomb -o a.hdr\n"
    assert_array_equal(radiance(flat().replace(b"\n", kept, 1)), radiance(flat()))


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (flat().replace(b"-Y 8 +X 16", b"+Y 8 +X 16"), "the size is '\\+Y 8 \\+X 16'; allowed: -Y HEIGHT \\+X WIDTH"),
        (flat().replace(b"-Y 8 +X 16", b"+X 16 -Y 8"), "allowed: -Y HEIGHT"),
        (flat().replace(b"-Y 8 +X 16", b"-Y 8 +X 15"), "has 15x8 pixels; allowed: .*twice as wide as high"),
        (flat().replace(b"-Y 8 +X 16", b"-Y 9999999 +X 19999998"), "pixels an edge"),
        (flat().replace(b"-Y 8 +X 16", b"-Y 8000 +X 16000"), "declares 16,000x8,000 pixels, but has 512 bytes"),
        (flat().replace(b"32-bit_rle_rgbe", b"32-bit_rle_xyze"), "FORMAT is '32-bit_rle_xyze'"),
        (flat().replace(b"\n\n", b"\nEXPOSURE=nan\n\n", 1), "EXPOSURE is 'nan'"),
        (flat().replace(b"\n\n", b"\nEXPOSURE=0\n\n", 1), "EXPOSURE is '0'"),
        (flat()[:-1], "row 7 is cut off"),
        (runs()[:-1], "row 7 is cut off"),
        (HEAD % (8, 16) + bytes([2, 2, 0, 17]) + bytes(600), "row 0 is cut off or has broken runs"),
        (HEAD % (8, 16) + bytes([2, 2, 0, 16, 128 + 17, 1]) + bytes(600), "row 0 is cut off or has broken runs"),
        (HEAD % (8, 16) + bytes([2, 2, 0, 16, 0, 0]) + bytes(600), "row 0 is cut off or has broken runs"),
        (HEAD % (2, 4) + bytes([1, 1, 1, 9]) * 8, "row 0 is cut off or has broken runs"),
        (b"#?RADIANCE\n" * 8000, "has no end of its header"),
        (b"P6 8 16", "is not a Radiance picture"),
    ],
)  # fmt: skip
def test_a_broken_file_is_one_line(data: bytes, said: str) -> None:
    with pytest.raises(InvalidFile, match=said):
        radiance(data)


def test_the_memory_limit_holds() -> None:
    with memory_limit(10_000), pytest.raises(MemoryLimit):
        radiance(flat(256))
