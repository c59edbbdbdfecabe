"""The photographs of a capture."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image as Pillow

from nerfbake.errors import InvalidFile, MemoryLimit
from nerfbake.io import find_photograph, load_photograph
from nerfbake.memory import left, memory_limit


def test_an_ending_may_be_left_out(tmp_path: Path) -> None:
    for name in ("a.png", "b.JPG", "c", "d.png.png"):
        (tmp_path / name).touch()
    found = {name: find_photograph(tmp_path, name) for name in ("a", "a.png", "b", "c", "d.png", "e", "")}
    names = {name: path and path.name for name, path in found.items()}
    assert names == {
        "a": "a.png", "a.png": "a.png", "b": "b.JPG", "c": "c", "d.png": "d.png.png", "e": None, "": None
    }  # fmt: skip


def test_a_folder_is_no_photograph(tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    (tmp_path / "a.png").touch()
    assert find_photograph(tmp_path, "a") == tmp_path / "a.png"


def test_the_file_is_named_in_what_is_wrong_with_it(tmp_path: Path) -> None:
    (tmp_path / "a.png").write_bytes(b"\x89PNG\r\n\x1a\nno more")
    with pytest.raises(InvalidFile, match=r"a\.png: the picture cannot be read .*; allowed: a whole PNG or JPEG"):
        load_photograph(tmp_path / "a.png")
    (tmp_path / "b.png").touch()
    with pytest.raises(InvalidFile, match=r"b\.png: is empty"):
        load_photograph(tmp_path / "b.png")
    with pytest.raises(InvalidFile, match=r"c\.png: No such file"):
        load_photograph(tmp_path / "c.png")


def test_photographs_count_for_as_long_as_they_live(tmp_path: Path) -> None:
    Pillow.fromarray(np.zeros((100, 100, 3), np.uint8)).save(tmp_path / "a.png")
    with memory_limit(210_000):
        kept = [load_photograph(tmp_path / "a.png") for _ in range(4)]
        assert left() == 210_000 - 4 * 40_000
        with pytest.raises(MemoryLimit, match=r"a\.png: the picture needs .* in addition to"):
            load_photograph(tmp_path / "a.png")
        kept.clear()
        assert left() == 210_000
