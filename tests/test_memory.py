"""The allowance of memory."""

from __future__ import annotations

import threading

import numpy as np
import pytest

from nerfbake import memory
from nerfbake.errors import MemoryLimit


def test_what_is_lent_comes_back() -> None:
    with memory.memory_limit(1000):
        with memory.lent("a table", 600):
            assert memory.left() == 400
            with pytest.raises(MemoryLimit, match=r"^another needs 401 B beside 600 B that are taken; allowed: 1000 B"):
                memory.require("another", 401)
        memory.require("another", 1000)
    assert memory.left() == memory.DEFAULT


def test_a_scope_gives_back_what_was_taken_in_it_even_if_it_fails() -> None:
    def two_tables() -> None:
        with memory.scope():
            memory.hold("the second", 500)
            memory.hold("the third", 500)

    with memory.memory_limit(1000):
        memory.hold("the first", 100)
        with pytest.raises(MemoryLimit, match="the third"):
            two_tables()
        assert memory.left() == 900


def test_outside_of_a_limit_nothing_adds_up() -> None:
    for _ in range(10):
        memory.hold("half of it", memory.DEFAULT // 2)
    assert memory.left() == memory.DEFAULT
    with pytest.raises(MemoryLimit, match=r"4\.0 GiB"):
        memory.hold("all and one", memory.DEFAULT + 1)


def test_limits_are_each_threads_own() -> None:
    seen: list[int] = []
    with memory.memory_limit(1000):
        thread = threading.Thread(target=lambda: seen.append(memory.left()))
        thread.start()
        thread.join()
    assert seen == [memory.DEFAULT]


def test_limits_within_limits() -> None:
    with memory.memory_limit(1000):
        memory.hold("something", 300)
        with memory.memory_limit(5000):
            assert memory.left() == 5000
        assert memory.left() == 700


def test_the_size_of_a_scene_is_that_of_its_arrays() -> None:
    parts = (np.zeros((3, 5), np.float32), [np.zeros(7, np.int8)], {"a": b"four", "b": memoryview(bytes(5))}, "text", 3)
    assert memory.size_of(parts) == 60 + 7 + 4 + 5
