"""Poses of panoramas: which pictures are taken for one, and how exact the poses are."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image as Pillow
from pillow_heif import register_heif_opener

from benchmarks.captures import position_errors
from nerfbake import Cameras, load
from nerfbake.errors import InvalidFile
from nerfbake.jobs import find_poses, poses
from nerfbake.kernels.arrays import Floats
from nerfbake.scene.lens import Lens
from tests.jobs.listener import Listener
from tests.support.panoramas import ALL_ROUND, GPANO, sighting_errors, tagged, write_panoramas


def groups_of(folder: Path, panoramas: bool = False) -> tuple[list[list[str]], list[list[str]], list[str]]:
    listener = Listener()
    names = sorted(path.name for path in folder.iterdir())
    flat, all_round, _ = poses._same_sizes(listener, folder, names, panoramas)
    return flat, all_round, listener.said


def rotation_errors(found: Cameras, known: Cameras) -> Floats:
    """Degrees between rotations, after the one that fits best turns the world."""
    turns = [np.stack([camera.pose[:3, :3] for camera in each.cameras]) for each in (found, known)]
    u, _, v = np.linalg.svd(np.einsum("nij,nkj->ik", turns[1], turns[0]))
    between = np.einsum("nij,nik->njk", (u @ v) @ turns[0], turns[1])
    return np.asarray(np.degrees(np.arccos(np.clip((np.trace(between, axis1=1, axis2=2) - 1) / 2, -1, 1))))


@pytest.mark.long
def test_panoramas_have_poses_and_points(tmp_path: Path) -> None:
    known = write_panoramas(tmp_path, frames=12, width=256, packet=ALL_ROUND)
    listener = Listener()
    assert find_poses(tmp_path, steps=listener)[1:3] == (12, 12)
    assert listener.said[0] == f"{tmp_path}: 12 of 12 pictures are panoramas of all directions"
    found = load(tmp_path, Cameras)
    assert [camera.picture for camera in found.cameras] == known.names
    assert {camera.lens for camera in found.cameras} == {Lens("equirectangular")}
    assert position_errors(found.eyes, known.eyes).max() < 0.01
    assert rotation_errors(found, known).max() < 0.5
    errors = sighting_errors(found)
    assert len(errors) > 1000
    assert errors.mean() < 0.5  # a pixel is 1.4 degrees


@pytest.mark.parametrize("kind", ["JPEG", "PNG", "HEIF"])
def test_a_picture_that_says_so_is_a_panorama(kind: str, tmp_path: Path) -> None:
    register_heif_opener()
    (tmp_path / "a.jpg").write_bytes(tagged((64, 32), ALL_ROUND, kind))
    assert groups_of(tmp_path) == ([], [["a.jpg"]], [f"{tmp_path}: 1 of 1 pictures are panoramas of all directions"])


CUT = 'GPano:ProjectionType="equirectangular" GPano:FullPanoWidthPixels="64" GPano:CroppedAreaImageWidthPixels="48"'


@pytest.mark.parametrize(
    ("size", "packet"),
    [
        ((64, 32), ""),
        ((64, 32), ALL_ROUND[:-4]),
        ((64, 32), GPANO.format('GPano:ProjectionType="cylindrical"')),
        ((64, 32), GPANO.format(CUT)),
        ((64, 48), ALL_ROUND),
    ],
)
def test_others_are_ordinary_photographs(size: tuple[int, int], packet: str, tmp_path: Path) -> None:
    (tmp_path / "a.jpg").write_bytes(tagged(size, packet))
    flat, all_round, said = groups_of(tmp_path)
    assert (flat, all_round) == ([["a.jpg"]], [])
    assert [text.partition("1 of 1 ")[2][:32] for text in said] == ["pictures are twice as wide as hi"] * (
        size[1] == 32
    )


def test_the_user_may_say_that_pictures_are_panoramas(tmp_path: Path) -> None:
    for i, size in enumerate(((64, 32), (64, 48), (32, 16))):
        Pillow.new("RGB", size).save(tmp_path / f"{i}.png")
    flat, all_round, said = groups_of(tmp_path)
    assert (flat, all_round) == ([["0.png"], ["1.png"], ["2.png"]], [])
    assert "warning: 2 of 3 pictures are twice as wide as high, but do not say" in said[0]
    assert groups_of(tmp_path, panoramas=True)[:2] == ([["1.png"]], [["0.png"], ["2.png"]])


def test_a_damaged_picture_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.jpg").write_bytes(tagged((64, 32), ALL_ROUND)[:900])
    with pytest.raises(InvalidFile, match=r"a\.jpg: the picture cannot be read"):
        groups_of(tmp_path)
