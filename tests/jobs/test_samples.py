"""Synthetic scenes as files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from nerfbake import Cameras, Image, N3Tree, Stage1, build_field, load, render_field, sample_n3tree
from nerfbake.errors import OutputError, UsageError
from nerfbake.jobs import write_sample_capture, write_sample_n3tree, write_sample_stage1


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


def test_a_capture_has_the_photographs_that_its_cameras_took(tmp_path: Path) -> None:
    write_sample_capture(tmp_path, frames=3, edge=24)
    cameras = load(tmp_path, Cameras)
    assert (len(cameras.cameras), cameras.samples) == (3, 2)
    field = build_field(sample_n3tree())
    for camera in cameras.cameras:
        image = load(tmp_path / f"{camera.name}.png", Image)
        again = render_field(field, camera, background=None, samples=2)
        assert np.abs(image.alpha - again.alpha).max() <= 0.5 / 255 + 1e-6
        assert 0.05 < float(image.alpha.mean()) < 0.9
    with pytest.raises(OutputError, match="exists already"):
        write_sample_capture(tmp_path, frames=3, edge=24)
    with pytest.raises(UsageError, match="a folder"):
        write_sample_capture("-")
