"""Running sums and sorts on a software device, against NumPy."""

from __future__ import annotations

import numpy as np
import pytest

from nerfbake.device.gpu import Gpu
from nerfbake.device.sorting import scan_on, sort_on


@pytest.mark.parametrize("count", [1, 2048, 2049, 3 * 2048 + 5, 256 * 2048 + 2049])
def test_a_scan_is_the_sum_of_those_before(gpu: Gpu, count: int) -> None:
    numbers = np.random.default_rng(0).integers(0, 5, count + 3).astype(np.uint32)
    data = gpu.upload(numbers)
    gpu.submit(scan_on(gpu, data, count))
    found = gpu.read(data, np.uint32, count + 3)
    np.testing.assert_array_equal(found[:count], np.cumsum(numbers[:count]) - numbers[:count])
    np.testing.assert_array_equal(found[count:], numbers[count:])


@pytest.mark.parametrize(("count", "room", "bits"), [(0, 10, 4), (7, 7, 3), (2048, 2048, 32), (5000, 9000, 9)])
def test_equal_keys_keep_their_order(gpu: Gpu, count: int, room: int, bits: int) -> None:
    entries = np.zeros((room, 2), np.uint32)
    entries[:count, 0] = np.random.default_rng(0).integers(0, 1 << bits, count)
    entries[:, 1] = np.arange(room)
    extent = gpu.upload(np.array([9, count], np.uint32))
    sort = sort_on(gpu, extent, 1, room=room, bits=bits)
    for _ in range(2):
        gpu.write(sort.source, entries)
        gpu.submit(sort.work)
        found = gpu.read(sort.sorted, np.uint32, 2 * count).reshape(-1, 2) if count else entries[:0]
        wanted = entries[:count][np.argsort(entries[:count, 0], kind="stable")]
        np.testing.assert_array_equal(found, wanted)


def test_entries_beyond_the_room_are_left_out(gpu: Gpu) -> None:
    entries = np.stack([np.arange(20, 0, -1), np.arange(20)], axis=1).astype(np.uint32)
    sort = sort_on(gpu, gpu.upload(np.array([1000], np.uint32)), 0, room=20, bits=5)
    gpu.write(sort.source, entries)
    gpu.submit(sort.work)
    np.testing.assert_array_equal(gpu.read(sort.sorted, np.uint32, 40).reshape(-1, 2), entries[::-1])
