"""The captures benchmark: how pictures are shrunk, and how positions are compared."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.testing import assert_allclose
from PIL import Image as Pillow

from benchmarks import captures
from benchmarks.captures import Row, position_errors
from benchmarks.scenes import Scenes
from tests.support.photographs import write_picture


def test_a_similarity_is_no_error_and_a_moved_camera_is_one() -> None:
    given = np.array([[1.0, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 2], [0, 0, -2]])
    turned = 3 * given @ np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]]) + 5
    assert_allclose(position_errors(turned, given), 0, atol=1e-12)
    turned[0] += [0, 0, 0.6]  # 0.2 of the given world, where the farthest camera is 2 away: 10 %, before the alignment
    errors = position_errors(turned, given)
    assert 0.05 < errors[0] == errors.max() < 0.1


def test_a_mirror_image_is_an_error() -> None:
    given = np.random.default_rng(0).normal(size=(9, 3))
    assert position_errors(given * [-1, 1, 1], given).max() > 0.3


def test_pictures_are_averaged_and_everything_else_is_copied(tmp_path: Path) -> None:
    plush = tmp_path / "captures" / "plush"
    pixels = np.random.default_rng(0).integers(0, 256, (4, 6, 3), np.uint8)
    write_picture(plush / "images" / "a.PNG", pixels)
    (plush / "sparse" / "0").mkdir(parents=True)
    (plush / "sparse" / "0" / "cameras.bin").write_bytes(b"cameras")
    scenes = Scenes(tmp_path, tmp_path / "made")
    made = captures._capture(Row("", "plush", 2, ()), scenes, scenes.folder)
    assert (made / "sparse" / "0" / "cameras.bin").read_bytes() == b"cameras"
    with Pillow.open(made / "images" / "a.PNG") as picture:
        assert_allclose(np.asarray(picture), pixels.reshape(2, 2, 3, 2, 3).mean(axis=(1, 3)), atol=0.51)
    assert captures._capture(Row("", "plush", 1, ()), scenes, scenes.folder) == plush
