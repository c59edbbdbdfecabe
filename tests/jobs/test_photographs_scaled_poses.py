"""Captures whose poses are a rotation times a number (instant-ngp#1229), mirrored, or not at right angles."""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from nerfbake import Cameras, load
from nerfbake.jobs import FitOptions, Source, fit_file
from nerfbake.jobs.photographs import read_photographs
from nerfbake.jobs.steps import SILENT
from nerfbake.jobs.views import read_cameras
from nerfbake.stages._ray_targets import ray_targets
from nerfbake.stages.views_to_hull import carve_hull
from tests.jobs.listener import Listener
from tests.support.photographs import write_scene

ROTATION = "has a pose that is not a rotation; allowed: right-handed axes of length 1, at right angles"


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_scene(tmp_path_factory.mktemp("capture"), frames=8, edge=24)


def times(capture: Path, folder: Path, factors: Sequence[float] | float) -> Path:
    """Copy a capture; multiply the columns of all rotations by these factors."""
    shutil.copytree(capture, folder)
    for path in folder.glob("transforms*.json"):
        fields = json.loads(path.read_text())
        for frame in fields["frames"]:
            pose = np.array(frame["transform_matrix"])
            pose[:3, :3] *= factors
            frame["transform_matrix"] = pose.tolist()
        path.write_text(json.dumps(fields))
    return folder


@pytest.mark.parametrize("scale", [1.3, 0.1])
def test_a_scale_changes_nothing_and_is_told(scale: float, capture: Path, tmp_path: Path) -> None:
    listener = Listener()
    scaled = read_photographs(listener, Source(str(times(capture, tmp_path / "scaled", scale))))
    good = read_photographs(SILENT, Source(str(capture)))
    told = [line for line in listener.said if "rotation" in line]
    said = "poses are a rotation times {:g}, which is divided out"
    assert [line.partition("the axes of ")[2] for line in told] == [
        f"8 of 8 {said.format(scale)}",
        f"2 of 2 {said.format(scale)}",
    ]
    a, b = (ray_targets(split.training, 0, scale=1, samples=2, ring=0) for split in (good, scaled))
    np.testing.assert_allclose(a.directions, b.directions, atol=1e-6)
    hulls = [carve_hull(split.training, resolution=16) for split in (good, scaled)]
    np.testing.assert_allclose(hulls[0].box, hulls[1].box, atol=1e-9)
    assert hulls[0].n == hulls[1].n


@pytest.mark.parametrize("factors", [(-1, 1, 1), (0.5, 0.5, 1), (-1, -1, -1)])
def test_axes_that_are_no_rotation_are_a_warning(factors: Sequence[float], capture: Path, tmp_path: Path) -> None:
    listener = Listener()
    path = times(capture, tmp_path / "wrong", factors) / "transforms_train.json"
    cameras = read_cameras(listener, str(path))
    assert listener.said[-1] == f"{path}: warning: camera 0000 {ROTATION} (and 7 more)"
    assert str(load(path, Cameras).problems()[0]) == f"camera 0000 {ROTATION} (and 7 more)"
    assert len(cameras.cameras) == 8


def test_rays_of_axes_of_different_lengths_are_unit_vectors(capture: Path, tmp_path: Path) -> None:
    split = read_photographs(SILENT, Source(str(times(capture, tmp_path / "wrong", (0.5, 0.5, 0.1)))))
    rays = ray_targets(split.training, 0, scale=1, samples=1, ring=0).directions
    np.testing.assert_allclose(np.linalg.norm(rays, axis=1), 1, atol=1e-6)


@pytest.mark.data
@pytest.mark.long
def test_a_scaled_capture_fits_as_well_as_a_good_one(data: Path, tmp_path: Path) -> None:
    good = data / "reports" / "F1_scaled_poses" / "good"
    found = []
    for name, scale in (("good", 1.0), ("smaller", 0.1)):
        place, options = times(good, tmp_path / name, scale), FitOptions(preset="fast", resolution=32)
        found.append(fit_file(place, tmp_path / f"{name}.npz", options=options).psnr)
    assert found[0] > 21.9  # 13.59 dB with 0.1, before the scale was divided out
    assert found[1] == pytest.approx(found[0], abs=0.02)
