"""Which way is up in photographs, by what their cameras store."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image as Pillow

from nerfbake.io import load_metadata
from tests.support.gravity import apple_note, write_apple, write_drone
from tests.support.heic import heic_of
from tests.support.panoramas import GPANO, tagged

HALF, ROOT = 0.5, 3**0.5 / 2


@pytest.mark.parametrize(
    ("pitch", "roll", "up"),
    [
        (0, 0, (0, 1, 0)),
        (-90, 0, (0, 0, 1)),  # what points up is behind a camera that looks down
        (-30, 0, (0, ROOT, HALF)),
        (0, 30, (-HALF, ROOT, 0)),  # the right side is lower, so up is to the left
        (0, 180, (0, -1, 0)),
    ],
)
def test_a_drone_stores_the_angles_of_its_gimbal(pitch: float, roll: float, up: object, tmp_path: Path) -> None:
    assert load_metadata(write_drone(tmp_path / "a.jpg", pitch, roll)).up == pytest.approx(up, abs=1e-12)


def test_a_stitcher_stores_the_angles_of_a_panorama(tmp_path: Path) -> None:
    packet = GPANO.format('GPano:PosePitchDegrees="-30" GPano:PoseRollDegrees="0.0"')
    (tmp_path / "a.png").write_bytes(tagged((64, 32), packet, "PNG"))
    assert load_metadata(tmp_path / "a.png").up == pytest.approx((0, ROOT, HALF), abs=1e-12)


def test_the_gimbal_says_nothing_of_a_panorama_that_a_drone_stitched(tmp_path: Path) -> None:
    """A real one of DJI has both groups of properties, without the pose of GPano."""
    gimbal = 'xmlns:dji="http://www.dji.com/drone-dji/1.0/" dji:GimbalPitchDegree="-90" dji:GimbalRollDegree="+0.00"'
    path = tmp_path / "a.jpg"
    for pose, up in (("", None), (' GPano:PosePitchDegrees="0" GPano:PoseRollDegrees="0"', (0, 1, 0))):
        packet = GPANO.format(f'GPano:ProjectionType="equirectangular" {gimbal}{pose}')
        path.write_bytes(tagged((64, 32), packet, "JPEG"))
        assert load_metadata(path).up == (up and pytest.approx(up))


# As three real photographs of iPhones have it, which were looked at: held level, looking up and looking down.
@pytest.mark.parametrize(
    ("acceleration", "up"),
    [((-1, 0, 0), (0, 1, 0)), ((-0.8, 0, 0.6), (0, 0.8, -0.6)), ((0, -0.8, -0.6), (-0.8, 0, 0.6))],
)
def test_an_iphone_stores_its_acceleration(acceleration: tuple[float, ...], up: object, tmp_path: Path) -> None:
    assert load_metadata(write_apple(tmp_path / "a.jpg", np.array(acceleration))).up == pytest.approx(up)


def test_a_heic_is_upright_when_it_is_decoded(tmp_path: Path) -> None:
    data = heic_of(Pillow.new("RGB", (64, 48)), note=apple_note(np.array([0, -1.0, 0])))  # held upright: orientation 6
    (tmp_path / "a.heic").write_bytes(data)
    assert load_metadata(tmp_path / "a.heic").up == pytest.approx((0, 1, 0))


def test_a_gain_map_behind_a_photograph_changes_nothing(tmp_path: Path) -> None:
    level, more = np.array([-1.0, 0, 0]), [Pillow.new("L", (4, 3))]
    assert load_metadata(write_apple(tmp_path / "a.jpg", level, more=more)).up == pytest.approx((0, 1, 0))
    assert load_metadata(write_apple(tmp_path / "b.jpg", level, size=(6, 8), more=more)).up is None  # it was turned


def test_what_says_nothing_is_none(tmp_path: Path) -> None:
    level, path = np.array([-1.0, 0, 0]), tmp_path / "a.jpg"
    assert load_metadata(write_apple(path, 1.5 * level)).up is None  # it moved
    assert load_metadata(write_apple(path, level, size=(6, 8))).up is None  # it was turned
    assert load_metadata(write_apple(path, level, lens="front camera")).up is None
    assert load_metadata(write_drone(path, float("nan"), 0)).up is None
    data = write_apple(path, level).read_bytes()
    for length in range(0, len(data), 7):
        path.write_bytes(data[:length])
        load_metadata(path)
