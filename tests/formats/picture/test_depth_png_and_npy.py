"""Depth as 16-bit PNG and as .npy."""

from __future__ import annotations

import io

import numpy as np
import numpy.typing as npt
import pytest
from numpy.testing import assert_array_equal
from PIL import Image as Pillow

from nerfbake.errors import InvalidFile, InvalidScene, MemoryLimit
from nerfbake.formats.picture import depth_npy, depth_png
from nerfbake.formats.picture import png as image_png
from nerfbake.memory import memory_limit
from nerfbake.scene.image import Depth, Image


def distances() -> npt.NDArray[np.float32]:
    return np.array([[0, 0.0001, 1.5], [2.0004, 65.535, 3.2506]], np.float32)


def test_steps_are_thousandths_and_nothing_met_is_0() -> None:
    data = b"".join(depth_png.encode(Depth(distances())))
    with Pillow.open(io.BytesIO(data)) as seen:
        assert_array_equal(np.asarray(seen), [[0, 1, 1500], [2000, 65535, 3251]])
    assert data[24:26] == b"\x10\x00"  # 16 bits of grey, in the PNG's own header
    assert depth_png.recognise(memoryview(data[:512]))
    assert_array_equal(depth_png.decode(memoryview(data)).distance[0], np.array([0, 0.001, 1.5], np.float32))


def test_what_16_bits_do_not_hold_is_refused() -> None:
    with pytest.raises(InvalidScene, match=r"depth reaches 65.54 world units; allowed: up to 65.535 in"):
        list(depth_png.encode(Depth(np.full((1, 1), 65.54, np.float32))))


def test_numpy_reads_what_is_written() -> None:
    data = b"".join(bytes(piece) for piece in depth_npy.encode(Depth(distances())))
    assert_array_equal(np.load(io.BytesIO(data)), distances())
    assert depth_npy.recognise(memoryview(data[:512]))
    assert_array_equal(depth_npy.decode(memoryview(data)).distance, distances())


def test_hostile_files_are_refused() -> None:
    good = b"".join(bytes(piece) for piece in depth_npy.encode(Depth(distances())))
    whole = io.BytesIO()
    np.save(whole, np.zeros((2, 3)))
    nan = good[:-4] + np.float32(np.nan).tobytes()
    for data in (good[:-1], good[:40], good + b"x", whole.getvalue(), b"\x93NUMPY", nan):
        with pytest.raises((InvalidFile, InvalidScene), match="allowed"), memory_limit(1000):
            depth_npy.decode(memoryview(data))
    flat = np.zeros((2, 2), np.float32)
    picture = b"".join(image_png.encode(Image(np.zeros((2, 2, 3), np.float32), flat, flat)))
    with pytest.raises(InvalidFile, match="holds RGB pixels; allowed: 16 bits of grey"), memory_limit(1000):
        depth_png.decode(memoryview(picture))
    with pytest.raises(MemoryLimit), memory_limit(10):
        depth_png.decode(memoryview(b"".join(depth_png.encode(Depth(distances())))))
