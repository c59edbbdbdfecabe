"""The allowance of memory."""

from __future__ import annotations

import threading
from collections.abc import Callable

import numpy as np
import pytest

from nerfbake import (
    Meshes,
    OctahedralAtlas,
    SpecularField,
    bake_atlas,
    compare_scenes,
    identify_colours,
    measure_atlas_error,
    memory,
    orbit_cameras,
    sample_n3tree,
    sample_stage1,
)
from nerfbake.errors import MemoryLimit
from nerfbake.kernels.maths.elementary import fibonacci
from nerfbake.scene.comparison import Comparison
from nerfbake.stages.stage1_to_atlas import AtlasError
from tests.support.meshes import cube
from tests.support.peaks import resident


def test_what_is_lent_comes_back() -> None:
    with memory.memory_limit(1000):
        with memory.lent("a table", 600):
            assert memory.left() == 400
            with pytest.raises(MemoryLimit, match=r"^another needs 401 B in addition to 600 B in use; allowed: 1000 B"):
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


def _texture(edge: int, shades: int = 256) -> SpecularField:
    """A feature texture whose texels have nearly all a colour of their own, unless there are few shades."""
    random = np.random.default_rng(0)
    features = random.integers(0, shades, (edge, edge, 3)).astype(np.uint8)
    w0, w1 = (random.normal(0, 1, shape).astype(np.float32) for shape in ((6, 8), (8, 3)))
    return SpecularField(features, w0, w1, np.ones((edge, edge), bool))


def _measured(maps: int, directions: int) -> AtlasError:
    atlas = OctahedralAtlas("kmeans", np.zeros((maps, 2, 2, 3), np.uint8), np.zeros((16, 16), np.uint16))
    return measure_atlas_error(atlas, _texture(16), directions=fibonacci(directions))


def _compared(edge: int) -> Comparison:
    mesh = Meshes((cube(),))
    return compare_scenes(mesh, mesh, orbit_cameras(mesh, width=edge, height=edge), keep_pictures=False)


@pytest.mark.parametrize(
    ("what", "stage", "limit"),
    [
        ("a tree of 64 cells an axis", lambda: sample_n3tree(resolution=64, basis="SH1"), 1 << 20),
        ("textures of 256x256", lambda: sample_stage1(resolution=256), 8 << 20),
        (
            "the texture's labels",
            lambda: bake_atlas(_texture(256, 4), clusters=2, map_size=2),
            1 << 20,
        ),
        ("65,[0-9]+ colours", lambda: identify_colours(_texture(256), directions=fibonacci(4)), 16 << 20),
        ("256 colours in 500 directions", lambda: identify_colours(_texture(16), directions=fibonacci(500)), 4 << 20),
        ("4,096 maps in 100 directions", lambda: _measured(4096, 100), 8 << 20),
        ("a picture of 256x256 pixels", lambda: _compared(256), 16 << 20),
    ],
)
def test_stages_ask_before_they_allocate(what: str, stage: Callable[[], object], limit: int) -> None:
    with memory.memory_limit(limit), pytest.raises(MemoryLimit, match=f"^{what} "):
        stage()
    with memory.memory_limit(4 * limit):
        stage()


def test_freed_memory_between_arrays_that_stay_is_given_back() -> None:
    arrays = [np.ones(100 << 10, np.uint8) for _ in range(400)]
    kept, before = arrays[::20], resident()
    del arrays
    memory.give_back()
    assert before - resident() > 20 << 20
    assert len(kept) == 20
