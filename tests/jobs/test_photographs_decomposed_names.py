"""Names of photographs that a file composes and the disk decomposes, as macOS does, or the other way round."""

from __future__ import annotations

import json
import unicodedata
from collections.abc import Callable
from pathlib import Path
from typing import Literal

import pytest
from numpy.testing import assert_array_equal

from nerfbake import Cameras, io, load
from nerfbake.errors import InvalidFile
from nerfbake.io.reading import find_photograph
from nerfbake.jobs import PhotographOptions, Source
from nerfbake.jobs.photographs import SplitViews, read_photographs
from nerfbake.jobs.steps import SILENT
from nerfbake.scene.image import Image
from tests.support.captures import rig, write_colmap_text, write_nerf_synthetic, write_nerfstudio, write_nsvf
from tests.support.photographs import over, photographed, spot, write_picture

Form = Literal["NFC", "NFD"]
FORMS: list[tuple[Form, Form]] = [("NFC", "NFD"), ("NFD", "NFC")]  # in the file, on the disk
BOTH: tuple[Form, Form] = FORMS[0]


def read(path: Path, **options: str) -> SplitViews:
    return read_photographs(SILENT, Source(str(path)), PhotographOptions(holdout=3, **options))  # type: ignore[arg-type]


def renamed(folder: Path, inside: str, form: Form) -> None:
    """Give the pictures in a subfolder, and the subfolder, names with accents in this form."""
    for path in (folder / inside).iterdir():
        path.rename(path.with_name(unicodedata.normalize(form, f"Küche é {path.name}")))


def replaced(path: Path, form: Form) -> None:
    path.write_text(path.read_text().replace("r_", unicodedata.normalize(form, "Küche é r_")))


def colmap(folder: Path, form: Form, stored: Form) -> None:
    photographed(write_colmap_text, folder)
    replaced(folder / "sparse" / "images.txt", form)
    renamed(folder, "images", stored)


def nsvf(folder: Path, form: Form, stored: Form) -> None:
    photographed(write_nsvf, folder)
    renamed(folder, "pose", form)
    renamed(folder, "rgb", stored)


def transforms(folder: Path, form: Form, stored: Form) -> None:
    photographed(write_nerfstudio, folder)
    path = folder / "transforms.json"
    fields = json.loads(path.read_text())
    for frame in fields["frames"]:
        frame["file_path"] = unicodedata.normalize(form, frame["file_path"].replace("/", "/Zürich/Küche é "))
    path.write_text(json.dumps(fields, ensure_ascii=False))
    renamed(folder, "images", stored)
    inner = folder / "images" / unicodedata.normalize(stored, "Zürich")
    inner.mkdir()
    for picture in (folder / "images").glob("*.png"):
        picture.rename(inner / picture.name)


@pytest.mark.parametrize(("form", "stored"), FORMS)
@pytest.mark.parametrize("write", [colmap, nsvf, transforms])
def test_each_camera_gets_its_picture(
    write: Callable[[Path, Form, Form], None], form: Form, stored: Form, tmp_path: Path
) -> None:
    write(tmp_path, form, stored)
    training, held_out = read(tmp_path)
    assert [camera.name for camera in held_out.cameras.cameras] == ["Küche é r_0"]
    assert [camera.name for camera in training.cameras.cameras] == ["Küche é r_1", "Küche é r_2"]
    for i, pixels in enumerate(training.pictures, start=1):
        assert_array_equal(pixels, spot(14, 10, i))


@pytest.mark.parametrize(("form", "stored"), FORMS)
def test_the_size_of_a_picture_is_found(form: Form, stored: Form, tmp_path: Path) -> None:
    photographed(write_nerf_synthetic, tmp_path)
    replaced(tmp_path / "transforms_test.json", form)
    renamed(tmp_path, "test", stored)
    read_ones = load(tmp_path, Cameras)
    assert (read_ones.cameras[0].width, read_ones.cameras[0].height, read_ones.notes) == (14, 10, ())


@pytest.mark.parametrize(("form", "stored"), FORMS)
def test_masks_and_photographs_to_compare_with_are_found(form: Form, stored: Form, tmp_path: Path) -> None:
    nsvf(tmp_path / "capture", form, form)
    masks = tmp_path / "masks"
    made = rig(odd=False)
    for i in range(3):
        name = unicodedata.normalize(stored, f"Küche é r_{i}.png")
        write_picture(masks / name, over(spot(made.width, made.height, 20), (0, 0, 0)))
    assert len(read(tmp_path / "capture", masks=str(masks)).training.pictures) == 2
    names = [camera.name for camera in load(tmp_path / "capture", Cameras).cameras]
    assert len(list(io.Truth(masks, names, Image))) == 3


def test_an_exact_name_comes_first_and_its_extension_is_optional(tmp_path: Path) -> None:
    for form in BOTH:
        (tmp_path / unicodedata.normalize(form, "é.JPG")).write_bytes(form.encode())
    for form in BOTH:
        for ending in ("", ".jpg", ".JPG"):
            found = find_photograph(tmp_path, unicodedata.normalize(form, "é") + ending)
            assert found is not None
            assert found.read_bytes() == form.encode()
    assert find_photograph(tmp_path, "è") is None
    (tmp_path / "K.png").write_bytes(b"")
    assert find_photograph(tmp_path, "\u212a.png") == tmp_path / "K.png"  # a kelvin sign, which is equal to K


def test_a_name_of_255_bytes_is_taken_and_a_longer_one_names_its_camera(tmp_path: Path) -> None:
    long = "x" * 251
    assert find_photograph(tmp_path, "y" * 250) is None
    for ending in (".png", ".PNG", ".JPG"):
        (tmp_path / (long + ending)).write_bytes(b"")
        assert find_photograph(tmp_path, long) == tmp_path / (long + ending)
        (tmp_path / (long + ending)).unlink()
    write_nsvf(tmp_path / "capture", rig(odd=False))
    pose = tmp_path / "capture" / "pose"
    (pose / "r_0.txt").rename(pose / f"{long}.txt")
    with pytest.raises(InvalidFile, match=r"capture: camera x{120} has a picture that cannot be looked up \(File name"):
        read(tmp_path / "capture")


@pytest.mark.data
def test_the_capture_of_a_mac_is_read(data: Path) -> None:
    training, held_out = read(data / "reports" / "F8_nfd_names" / "capture")
    assert (len(training.pictures), len(held_out.pictures)) == (6, 4)
    assert held_out.cameras.cameras[0].name == "Küche 0"
