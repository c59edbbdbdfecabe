"""Synthetic scenes as files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from nerfbake import N3Tree, Stage1, load
from nerfbake.errors import OutputError
from nerfbake.jobs import write_sample_n3tree, write_sample_stage1


def test_a_tree_is_what_was_written(tmp_path: Path) -> None:
    tree = write_sample_n3tree(tmp_path / "a.npz", resolution=8, basis="SH1")
    np.testing.assert_array_equal(load(tmp_path / "a.npz", N3Tree).data, tree.data)
    with pytest.raises(OutputError, match="exists already"):
        write_sample_n3tree(tmp_path / "a.npz", resolution=7)


def test_a_stage1_folder_is_what_was_written(tmp_path: Path) -> None:
    scene = write_sample_stage1(tmp_path / "in", resolution=32)
    np.testing.assert_array_equal(load(tmp_path / "in", Stage1).fields[0].features, scene.fields[0].features)
    with pytest.raises(OutputError, match="exists already"):
        write_sample_stage1(tmp_path / "in", resolution=7)
