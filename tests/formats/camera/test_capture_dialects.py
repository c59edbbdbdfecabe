"""One rig in every dialect of cameras: the same rays."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

from nerfbake import Cameras, load, save
from tests.support.captures import (
    Rig,
    rig,
    write_colmap_binary,
    write_colmap_text,
    write_instant_ngp,
    write_llff,
    write_nerf_synthetic,
    write_nerfstudio,
    write_nsvf,
)

Writer = Callable[[Path, Rig], Path]

# What each reader has to say it took, and whose dialect that is.
PLAIN: dict[str, tuple[Writer, str, str]] = {
    "NeRF-Synthetic": (write_nerf_synthetic, "transforms_test.json", "NeRF-Synthetic"),
    "LLFF": (write_llff, "poses_bounds.npy", "LLFF"),
    "NSVF, a line": (lambda folder, made: write_nsvf(folder, made, "line"), "intrinsics.txt, pose/*.txt", "NSVF"),
}
ODD: dict[str, tuple[Writer, str, str]] = {
    "instant-ngp": (write_instant_ngp, "transforms.json", "instant-ngp"),
    "nerfstudio": (write_nerfstudio, "transforms.json", "nerfstudio"),
    "COLMAP binary": (write_colmap_binary, "sparse/0/images.bin", "COLMAP"),
    "COLMAP text": (write_colmap_text, "sparse/images.txt", "COLMAP"),
    "LLFF, shared": (lambda folder, made: write_llff(folder, made, shared=True), "poses_bounds.npy", "LLFF"),
    "NSVF, 4 x 4": (write_nsvf, "intrinsics.txt, pose/*.txt", "NSVF"),
    "NSVF, 3 x 3": (lambda folder, made: write_nsvf(folder, made, "3x3"), "intrinsics.txt, pose/*.txt", "NSVF"),
    "NSVF, 16": (lambda folder, made: write_nsvf(folder, made, "16"), "intrinsics.txt, pose/*.txt", "NSVF"),
}
CASES = [(name, odd) for odd, names in ((False, [*PLAIN, *ODD]), (True, [*ODD])) for name in names]


@pytest.mark.parametrize(("name", "odd"), CASES)
def test_one_rig_has_the_same_rays_in_every_dialect(name: str, odd: bool, tmp_path: Path) -> None:
    made = rig(odd=odd)
    write, source, dialect = (PLAIN | ODD)[name]
    read = load(write(tmp_path / "capture", made), Cameras)
    assert (read.source, read.dialect, read.notes) == (source, dialect, ())
    assert [camera.name for camera in read.cameras] == made.names
    for i, camera in enumerate(read.cameras):
        assert (camera.width, camera.height) == (made.width, made.height)
        place, directions = camera.rays()
        assert_allclose(place, made.poses[i, :3, 3], rtol=0, atol=1e-12)
        assert_allclose(directions, made.directions(i), rtol=0, atol=1e-12)
    assert read.problems() == []


@pytest.mark.parametrize("scale", [1.3, 0.1])
@pytest.mark.parametrize("write", [write_nerf_synthetic, write_instant_ngp, write_nerfstudio, write_llff, write_nsvf])
def test_a_scale_of_poses_is_divided_out_in_every_dialect(write: Writer, scale: float, tmp_path: Path) -> None:
    made = rig(odd=False)
    poses = made.poses.copy()
    poses[:, :3, :3] *= scale
    read = load(write(tmp_path, replace(made, poses=poses)), Cameras)
    for camera, pose in zip(read.cameras, made.poses, strict=True):
        assert_allclose(camera.pose, pose, rtol=0, atol=1e-14)
    said = f"the axes of 3 of 3 poses are a rotation times {scale:g}, which is divided out"
    assert read.pose_notes == (said,)
    assert [problem.times for problem in read.problems()] == [3]  # `check` names it


def test_a_quaternion_of_any_length_is_the_same_rotation(tmp_path: Path) -> None:
    """As in COLMAP, which normalises quaternions."""
    made = load(write_colmap_text(tmp_path, rig(odd=False)), Cameras)
    images = tmp_path / "sparse" / "images.txt"
    lines = images.read_text().splitlines()
    for i in range(1, len(lines), 2):
        number, *rest = lines[i].split(" ")
        lines[i] = " ".join([number, *(repr(1.3 * float(value)) for value in rest[:4]), *rest[4:]])
    images.write_text("\n".join(lines) + "\n")
    read = load(tmp_path, Cameras)
    for camera, other in zip(made.cameras, read.cameras, strict=True):
        assert_allclose(camera.pose, other.pose, rtol=0, atol=1e-14)
    assert (read.pose_notes, read.problems()) == ((), [])


def test_what_is_written_has_the_same_rays_to_the_bit(tmp_path: Path) -> None:
    made = load(write_colmap_binary(tmp_path, rig(odd=True)), Cameras)
    save(tmp_path / "again.json", made)
    again = load(tmp_path / "again.json", Cameras)
    for one, other in zip(made.cameras, again.cameras, strict=True):
        assert (one.name, one.width, one.height) == (other.name, other.width, other.height)
        assert one.rays()[1].tobytes() == other.rays()[1].tobytes()


@pytest.mark.parametrize(
    ("write", "file"),
    [
        (write_colmap_binary, "sparse/0/cameras.bin"),
        (write_colmap_binary, "sparse/0/images.bin"),
        (write_colmap_text, "sparse/images.txt"),
        (write_llff, "poses_bounds.npy"),
        (write_nsvf, "intrinsics.txt"),
        (write_nerf_synthetic, "transforms_test.json"),
    ],
)
def test_a_file_stands_for_its_folder(write: Writer, file: str, tmp_path: Path) -> None:
    folder = write(tmp_path, rig(odd=False))
    one, other = load(folder, Cameras), load(folder / file, Cameras)
    assert [camera.name for camera in one.cameras] == [camera.name for camera in other.cameras]
    assert one.cameras[1].rays()[1].tobytes() == other.cameras[1].rays()[1].tobytes()


def test_the_first_of_several_is_taken_and_said(tmp_path: Path) -> None:
    made = rig(odd=False)
    for write, source in (
        (write_nsvf, "intrinsics.txt, pose/*.txt"),
        (write_llff, "poses_bounds.npy"),
        (write_colmap_text, "sparse/images.txt"),
        (write_colmap_binary, "sparse/0/images.bin"),
        (write_nerf_synthetic, "transforms_test.json"),
        (write_instant_ngp, "transforms.json"),
    ):
        assert load(write(tmp_path, made), Cameras).source == source


def test_sizes_that_nobody_tells_are_taken_for_granted_aloud(tmp_path: Path) -> None:
    made = rig(odd=False)
    for write, folder, note in (
        (
            write_nerf_synthetic,
            "test",
            "no size and no picture for 3 of its cameras; using 800x800, the size of the Blender scenes",
        ),
        (write_nsvf, "rgb", "no picture in rgb; using 14x10, with the principal point in the centre"),
    ):
        for picture in (write(tmp_path, made) / folder).iterdir():
            picture.unlink()
        (tmp_path / "poses_bounds.npy").unlink(missing_ok=True)
        assert load(tmp_path, Cameras).notes == (note,)
        (tmp_path / "transforms_test.json").unlink(missing_ok=True)


def test_poses_of_opencv_by_hand(tmp_path: Path) -> None:
    # A COLMAP camera at the world's origin, turned by half a turn about its y: it looks along -z, its y points down.
    (tmp_path / "cameras.txt").write_text("1 SIMPLE_PINHOLE 3 3 2 1.5 1.5\n")
    (tmp_path / "images.txt").write_text("1 0 0 1 0 0 0 5 1 a.png\n\n")
    (camera,) = load(tmp_path, Cameras).cameras
    place, directions = camera.rays()
    # x_cam = -x, y_cam = y, z_cam = 5 - z: it stands at z = 5, and -y is up in its picture.
    assert_allclose(place, [0, 0, 5], atol=1e-15)
    assert_allclose(directions[4], [0, 0, -1], atol=1e-15)
    assert directions[0][0] > 0 > directions[0][1]


def test_a_model_of_another_world_is_as_far_as_it_says(tmp_path: Path) -> None:
    made = rig(odd=False)
    read = load(write_llff(tmp_path, made), Cameras)
    np.testing.assert_array_equal([camera.pose for camera in read.cameras], made.poses)
