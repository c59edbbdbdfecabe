"""Directions that cameras look along count; the others hardly."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from nerfbake import weigh_directions
from nerfbake.cli.main import run
from nerfbake.errors import InvalidScene
from nerfbake.kernels.maths.elementary import fibonacci
from nerfbake.scene.mesh import Mesh

# A small triangle in the plane z = 0 whose front looks along +z.
CORNERS = np.array([[0, 0, 0], [0.01, 0, 0], [0, 0.01, 0]], np.float32)
TRIANGLE = Mesh(CORNERS, CORNERS[:, :2] * 100, np.array([[0, 1, 2]], np.uint32))


def test_a_camera_before_the_front_by_hand() -> None:
    directions = np.array([[0.0, 0, -1], [0, 0, 1], [1, 0, 0], [0, 1, 0]])
    # It looks along -z: all four counts, plus a tenth of their mean for each, scaled to a mean of 1.
    weights = weigh_directions(TRIANGLE, np.array([[0.0, 0, 5]]), directions)
    np.testing.assert_allclose(weights, np.array([4.1, 0.1, 0.1, 0.1]) / 1.1)


def test_a_camera_behind_sees_nothing() -> None:
    with pytest.raises(InvalidScene, match="see no front"):
        weigh_directions(TRIANGLE, np.array([[0.0, 0, -5]]), fibonacci(20))


def test_the_command_bakes_for_the_cameras(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source, transforms = str(tmp_path / "in"), tmp_path / "t.json"
    assert run(["sample", "nerf2mesh", source, "--resolution", "64"]) == 0
    matrix = np.eye(4)
    matrix[:3, 3] = [0, 3, 0]
    transforms.write_text(json.dumps({"frames": [{"transform_matrix": matrix.tolist()}]}))
    labels = []
    for name, options in (("a", []), ("b", ["--direction-set", "cameras", "--transforms", str(transforms)])):
        assert run(["atlas", source, str(tmp_path / name), "--clusters", "8", "--map-size", "8", *options]) == 0
        labels.append((tmp_path / name / "labels_0.png").read_bytes())
    assert labels[0] != labels[1]
    capsys.readouterr()
    assert run(["atlas", source, str(tmp_path / "c"), "--direction-set", "cameras"]) == 1
    assert "transforms.json is missing" in capsys.readouterr().err
    for content in ("{}", '{"frames": []}', '{"frames": [{"transform_matrix": [[1]]}]}', "["):
        transforms.write_text(content)
        by_cameras = ["--direction-set", "cameras", "--transforms", str(transforms)]
        assert run(["atlas", source, str(tmp_path / "c"), *by_cameras]) == 1
        (line,) = capsys.readouterr().err.splitlines()
        assert "transforms.json" in line
