"""Real files of cameras of other tools, to the numbers of the page that describes them."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image as Pillow

from nerfbake import Cameras, load
from nerfbake.formats.camera.realitycapture_csv import turn_of_heading, turn_of_omega
from tests.support.reprojection import plane_of, reprojection_errors

pytestmark = pytest.mark.data

# The sample in the folder of samples, and the file of it that is read.
SAMPLES = {
    "3dgs/cameras.json": "",
    "metashape/geocentric_chunk.xml": "",
    "metashape/rolling_b1b2k4_chunk.xml": "",
    "metashape/local_1.5.xml": "",
    "realitycapture/*.xmp": "realitycapture/DJI_0085.xmp",
    "realitycapture/iecp_postshot_row.csv": "",
    "opensfm/v1_2020/reconstruction.json": "",
    "opensfm/v2_2026/reconstruction.json": "",
    "nvm/VisualSFM_example.nvm": "",
    "openmvg/sfm_data.json": "",
    "openmvg/fisheye_value0.json": "",
    "kapture/sensors": "kapture/sensors/sensors.txt",
    "mvsnet/made_00000000_cam.txt": "",
    "polycam/made": "polycam/made/keyframes/corrected_cameras/52637129.json",
}
# Samples that are not here, because their repositories have no licence that allows it.
ELSEWHERE = {"metashape/studio_2.0.xml", "meshroom/new_1.2.6.sfm", "meshroom/old_1.0.0.sfm", "bundler/bundle.out"}
ELSEWHERE |= {"odm/odm_report/shots.geojson", "record3d/metadata.json", "neus/cameras_sphere.npz"}
ELSEWHERE |= {f"trajectories/{name}" for name in ("tum.txt", "euroc_groundtruth.csv", "kitti.txt")}
OPENED = {"tnt/open3d_example.log"}  # in a test of its own


@pytest.fixture
def samples(data: Path) -> Path:
    return data / "cameras"


def expected(samples: Path) -> dict[str, list[dict[str, Any]]]:
    found: dict[str, list[dict[str, Any]]] = json.loads((samples / "expected.json").read_text())
    return found


def test_every_sample_is_tested_or_named(samples: Path) -> None:
    assert set(expected(samples)) == set(SAMPLES) | ELSEWHERE | OPENED


def with_pictures(samples: Path, sample: str, place: Path) -> Path:
    """Copy a sample, with an empty picture of the right size for each camera whose expected values name one."""
    file = SAMPLES[sample] or sample
    top, _, rest = file.partition("/")
    shutil.copytree(samples / top, place / top)
    for entry in expected(samples)[sample]:
        name = Path(entry["name"]).name
        picture = place / top / (name if "." in name else f"{name}.jpg")
        if entry["width"]:
            Pillow.new("L", (entry["width"], entry["height"])).save(picture)
    return place / top / rest


@pytest.mark.parametrize("sample", SAMPLES)
def test_a_sample_has_the_numbers_of_the_page(sample: str, samples: Path, tmp_path: Path) -> None:
    entries = expected(samples)[sample]
    sized = sample.startswith(("realitycapture", "nvm", "mvsnet"))  # the sizes are in the pictures
    source = with_pictures(samples, sample, tmp_path) if sized else samples / (SAMPLES[sample] or sample)
    cameras = load(source, Cameras)
    guessed = sample.startswith("mvsnet")  # its name was changed, so that its picture is not found
    by_name = {Path(camera.picture).stem: camera for camera in cameras.cameras}
    for entry in entries:
        camera = cameras.cameras[0] if guessed else by_name[Path(entry["name"]).stem]
        scale = max(1.0, *map(abs, entry["centre"]))
        assert np.abs(camera.pose[:3, 3] - entry["centre"]).max() < 1e-8 * scale
        assert np.abs(-camera.pose[:3, 2] - entry["viewing_direction"]).max() < 1e-8
        assert np.abs(camera.pose[:3, 1] - entry["image_up"]).max() < 1e-8
        if not guessed:
            assert (camera.width, camera.height) == (entry["width"], entry["height"])
        assert (camera.cx, camera.cy) == pytest.approx((entry["cx"], entry["cy"]), abs=1e-7)
        assert (camera.fx, camera.fy) == pytest.approx((entry["fx"], entry["fy"]), rel=1e-9)
        lens = camera.lens
        if entry["lens"] == "fisheye":
            assert lens is not None
            assert lens.model == "fisheye"
        found = {f"k{i}": value for i, value in enumerate(lens.k, start=1)} if lens else {}
        found |= dict(zip(("p1", "p2"), lens.p, strict=True)) if lens else {}
        found |= {"skew": lens.skew * camera.fx} if lens else {}
        wanted = {{"k4r8": "k4"}.get(key, key): value for key, value in entry["distortion_opencv"].items()}
        assert {key: value for key, value in found.items() if value} == pytest.approx(wanted, rel=1e-9)


def test_agisoft_projects_a_point_where_our_camera_does(samples: Path) -> None:
    """By Agisoft's own project(): the point is in the chunk, and the pixel is (2391.71, 1481.90)."""
    cameras = load(samples / "metashape" / "geocentric_chunk.xml", Cameras)
    camera = cameras.cameras[0]
    assert camera.name == "DJI_0057"
    world = chunk_to_world(samples / "metashape" / "geocentric_chunk.xml", [11.870130675, 0.858098778, -12.987136541])
    seen = (world - camera.pose[:3, 3]) @ camera.pose[:3, :3] * [1, -1, -1]
    plane = plane_of(camera, np.array([[2391.7104647010, 1481.8987733175]]))
    away = (seen[:2] / seen[2] - plane[0]) * camera.fx
    assert np.abs(away).max() < 1e-5  # in ECEF a double has steps of 1e-9 m


def chunk_to_world(path: Path, point: list[float]) -> Any:
    from xml.etree import ElementTree

    root = ElementTree.parse(path).getroot()
    transform = next(iter(root.iter("component"))).find("transform")
    assert transform is not None
    turn, shift, scale = (
        [float(value) for value in str(transform.findtext(name)).split()]
        for name in ("rotation", "translation", "scale")
    )
    return scale[0] * np.array(turn).reshape(3, 3) @ point + np.array(shift)


@pytest.mark.parametrize(
    ("path", "most", "count"),
    [
        # The error of these reconstructions themselves: the page measures means of 1.77 and 1.32 on the whole files.
        ("opensfm/v1_2020/reconstruction.json", 2.0, 50),
        ("opensfm/v2_2026/reconstruction.json", 1.3, 50),
        ("nvm/VisualSFM_example.nvm", 0.5, 50),
        ("openmvg/sfm_data.json", 0.5, 8),
    ],
)
def test_points_are_seen_where_the_file_says(path: str, most: float, count: int, samples: Path, tmp_path: Path) -> None:
    sized = path in SAMPLES and path.startswith("nvm")
    source = with_pictures(samples, path, tmp_path) if sized else samples / path
    cameras = load(source, Cameras)
    if sized:  # only the first pictures have expected values; all have the same size
        assert {(camera.width, camera.height) for camera in cameras.cameras} == {(2832, 2128)}
    errors = reprojection_errors(cameras)
    assert len(errors) >= count
    assert float(np.median(errors)) < most


def test_the_angles_of_realitycapture_are_those_of_its_sidecars(samples: Path) -> None:
    pair = json.loads((samples / "realitycapture" / "hpr_forum_pair.json").read_text())
    turn = turn_of_heading(pair["heading"], pair["pitch"], pair["roll"])
    rows = (turn * [1, -1, -1]).T[:2].reshape(-1)
    assert np.abs(rows - pair["xmp_rotation_first_two_rows"]).max() < 1e-12
    sidecars = load(samples / "realitycapture" / "DJI_0085.xmp", Cameras)
    lines = (samples / "realitycapture" / "nxyzopk.csv").read_text().splitlines()[2:]
    for line in lines:
        name, *numbers = line.split(",")
        x, y, z, omega, phi, kappa = map(float, numbers)
        camera = next(camera for camera in sidecars.cameras if camera.name == Path(name).stem)
        assert np.abs(camera.pose[:3, 3] - [x, y, z]).max() < 1e-12
        assert np.abs(turn_of_omega(omega, phi, kappa) - camera.pose[:3, :3]).max() < 1e-12


def test_the_two_files_of_open3d_agree(samples: Path, tmp_path: Path) -> None:
    for path in (samples / "tnt").iterdir():
        shutil.copy(path, tmp_path)
    (tmp_path / "intrinsics.txt").write_text("525 0 319.5\n0 525 239.5\n0 0 1\n")
    log, fields = (load(tmp_path / f"open3d_example.{ending}", Cameras) for ending in ("log", "json"))
    entries = expected(samples)["tnt/open3d_example.log"]
    for camera, other in zip(log.cameras, fields.cameras, strict=True):
        assert np.abs(camera.pose - other.pose).max() < 5e-6  # the .log has six digits
        assert (camera.fx, camera.cx) == (other.fx, other.cx)
    for camera, entry in zip(log.cameras, entries, strict=False):
        assert np.abs(camera.pose[:3, 3] - entry["centre"]).max() < 1e-9
        assert np.abs(-camera.pose[:3, 2] - entry["viewing_direction"]).max() < 1e-9


def test_kapture_and_openmvg_have_the_same_cameras_but_for_half_a_pixel(samples: Path) -> None:
    one = load(samples / "kapture" / "sensors" / "sensors.txt", Cameras)
    other = load(samples / "openmvg" / "sfm_data.json", Cameras)
    for first, second in zip(one.cameras, other.cameras, strict=True):
        assert np.abs(first.pose - second.pose).max() < 1e-14
        assert (first.cx + 0.5, first.cy + 0.5) == (second.cx, second.cy)
