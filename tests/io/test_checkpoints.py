"""Where a piece of work stands, on the disk."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from nerfbake.errors import InvalidFile, OutputError
from nerfbake.io import checkpoint_path, load_checkpoint, require_checkpoints, save_checkpoint


def test_the_last_one_is_there_and_nothing_else(tmp_path: Path) -> None:
    require_checkpoints(tmp_path / "new" / "state")
    folder = tmp_path / "new" / "state"
    assert load_checkpoint(folder) is None
    for number in (1, 2):
        save_checkpoint(folder, {"number": number}, {"a": np.full(3, number)})
    found = load_checkpoint(folder)
    assert found is not None
    assert found[0] == {"number": 2}
    assert_array_equal(found[1]["a"], [2, 2, 2])
    assert list(folder.iterdir()) == [checkpoint_path(folder)]


def test_what_stands_beside_it_stays(tmp_path: Path) -> None:
    (tmp_path / "mine.txt").write_text("mine")
    require_checkpoints(tmp_path)
    save_checkpoint(tmp_path, {}, {})
    assert (tmp_path / "mine.txt").read_text() == "mine"


def test_a_writer_that_fails_leaves_the_last_one(tmp_path: Path) -> None:
    save_checkpoint(tmp_path, {"number": 1}, {})
    with pytest.raises(TypeError):
        save_checkpoint(tmp_path, {"number": 2}, {"a": np.ones(3), "b": np.array([None])})
    assert load_checkpoint(tmp_path) == ({"number": 1}, {})
    assert len(list(tmp_path.iterdir())) == 1


def test_what_cannot_be_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(OutputError, match=r"file: File exists"):
        require_checkpoints(tmp_path / "file")
    checkpoint_path(tmp_path).write_bytes(b"no archive")
    with pytest.raises(InvalidFile, match=r"checkpoint\.npz: is not a complete zip archive"):
        load_checkpoint(tmp_path)
