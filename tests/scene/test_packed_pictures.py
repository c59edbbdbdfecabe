from __future__ import annotations

import tracemalloc

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from nerfbake.errors import MemoryLimit
from nerfbake.memory import left, memory_limit
from nerfbake.scene.packed_pictures import PackedPicture, PackedPictures


def noise(height: int, width: int) -> np.ndarray:
    return np.random.default_rng(height).integers(0, 256, (height, width, 4), dtype=np.uint8)


def test_pictures_of_any_size_come_back_as_they_were() -> None:
    made = [noise(3, 4), np.zeros((50, 60, 4), np.uint8), noise(7, 1), noise(20, 30)[:, ::2]]
    pictures = PackedPictures.of(made)
    assert len(pictures) == 4
    for picture, packed in zip(made, pictures, strict=True):
        assert_array_equal(picture, packed)
        assert not packed.flags.writeable
    assert [picture.shape for picture in pictures[1:3]] == [(50, 60, 4), (7, 1, 4)]
    assert_array_equal(pictures.take([2, 0])[1], made[0])
    assert PackedPictures.of(pictures) is pictures


def test_compressed_bytes_count_as_memory_while_any_sequence_has_them() -> None:
    with memory_limit(100_000):
        pictures = PackedPictures.of([np.zeros((300, 300, 4), np.uint8), noise(100, 100)])
        assert 40_000 <= 100_000 - left() < 42_000
        second = pictures.take([1])
        del pictures
        assert 40_000 <= 100_000 - left() < 42_000
        del second
        assert left() == 100_000
        with pytest.raises(MemoryLimit, match="a compressed picture needs"):
            PackedPicture(noise(200, 200))


def test_compressing_takes_little_more_memory_than_the_compressed_bytes() -> None:
    """Larger pieces of memory left holes between the pictures: 0.6 GB for 300 of them."""
    pixels = np.zeros((1000, 1000, 4), np.uint8)
    tracemalloc.start()
    try:
        PackedPicture(pixels)
        assert tracemalloc.get_traced_memory()[1] < pixels.nbytes / 8
    finally:
        tracemalloc.stop()
