"""The photographs of a capture, in every dialect, and what is wrong with them in one line."""

from __future__ import annotations

import json
import shutil
import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from threading import Barrier
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from PIL import Image as Pillow

from nerfbake import Cameras, io, load
from nerfbake.errors import InvalidFile, InvalidScene, MemoryLimit, NerfbakeError, UsageError
from nerfbake.io.reading import is_picture
from nerfbake.jobs import PhotographOptions, Source
from nerfbake.jobs.photographs import SplitViews, read_photographs
from nerfbake.jobs.steps import SILENT
from nerfbake.memory import left, memory_limit
from tests.jobs.listener import Listener
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
from tests.support.photographs import over, photographed, spot, write_picture

DIALECTS = (
    write_nerf_synthetic, write_instant_ngp, write_nerfstudio, write_colmap_binary, write_colmap_text, write_llff,
    write_nsvf,
)  # fmt: skip


def read(path: Path | str, **options: Any) -> SplitViews:
    return read_photographs(SILENT, Source(str(path)), PhotographOptions(**options))


def many(count: int) -> Rig:
    """Cameras in a row."""
    made = rig(odd=False)
    poses = np.tile(made.poses[:1], (count, 1, 1))
    poses[:, 2, 3] += np.arange(count)
    return replace(made, poses=poses)


@pytest.mark.parametrize("write", DIALECTS)
def test_each_camera_gets_its_own_picture_in_every_dialect(write: Callable[..., Path], tmp_path: Path) -> None:
    made = many(5)
    training, held_out = read(photographed(write, tmp_path, made), holdout=3)
    names = [camera.name for camera in training.cameras.cameras]
    assert names == ["r_1", "r_2", "r_4"]
    assert [camera.name for camera in held_out.cameras.cameras] == ["r_0", "r_3"]
    for name, pixels, camera in zip(names, training.pictures, training.cameras.cameras, strict=True):
        number = int(name[2:])
        assert_array_equal(pixels, spot(made.width, made.height, number))
        np.testing.assert_allclose(camera.pose, made.poses[number], atol=1e-12)
    assert (training.masked, training.background) == (True, (1.0, 1.0, 1.0))


def test_pictures_of_a_model_that_stands_alone_are_above_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    photographed(write_colmap_binary, tmp_path, many(5))
    for place in ("sparse/0", "sparse/0/images.bin"):
        assert len(read(tmp_path / place).training.pictures) == 4
    monkeypatch.chdir(tmp_path / "sparse" / "0")
    assert len(read("images.bin").training.pictures) == 4


@pytest.mark.parametrize(("name", "place"), [("images/r_{}.png", "images"), ("r_{}.png", "."), ("a/r_{}.png", "a")])
def test_names_of_a_model_may_be_relative_to_the_capture(name: str, place: str, tmp_path: Path) -> None:
    made = many(5)
    write_colmap_text(tmp_path, made)
    images = tmp_path / "sparse" / "images.txt"
    text = images.read_text()
    for i in range(5):
        text = text.replace(f" r_{i}.png", " " + name.format(i))
        write_picture(tmp_path / name.format(i), spot(made.width, made.height, i))
    images.write_text(text)
    training, _ = read(tmp_path)
    assert [camera.picture for camera in training.cameras.cameras] == [name.format(i) for i in range(1, 5)]
    for i, pixels in enumerate(training.pictures, start=1):
        assert_array_equal(pixels, spot(made.width, made.height, i))
    (tmp_path / place / "r_3.png").write_bytes(b"GIF89a")
    with pytest.raises(InvalidFile, match=r"r_3\.png: the picture cannot be read"):
        read(tmp_path)


def test_every_eighth_view_judges_where_nothing_else_is_said(tmp_path: Path) -> None:
    split = read(photographed(write_nerfstudio, tmp_path, many(17)))
    assert [camera.name for camera in split.held_out.cameras.cameras] == ["r_0", "r_8", "r_16"]


def split_capture(folder: Path) -> Path:
    """transforms_train.json, and the same as _test.json with pictures of its own."""
    photographed(write_nerf_synthetic, folder, many(5))
    shutil.copytree(folder / "test", folder / "train")
    text = (folder / "transforms_test.json").read_text()
    (folder / "transforms_train.json").write_text(text.replace("./test/", "./train/"))
    return folder


def test_a_capture_with_views_to_judge_by_is_judged_by_them(tmp_path: Path, listener: Listener) -> None:
    split = read_photographs(listener, Source(str(split_capture(tmp_path))))
    assert (len(split.training.pictures), len(split.held_out.pictures)) == (5, 5)
    assert listener.phases == [
        f"reading {tmp_path}/transforms_train.json",
        "reading 5 pictures",
        f"reading {tmp_path}/transforms_test.json",
        "reading 5 pictures",
    ]
    assert len(read(tmp_path, holdout=2).held_out.pictures) == 3  # of those to train with
    assert len(read(tmp_path / "transforms_train.json").training.pictures) == 4
    split = read(tmp_path / "transforms_train.json", test=str(tmp_path / "transforms_test.json"))
    assert (len(split.training.pictures), len(split.held_out.pictures)) == (5, 5)
    with pytest.raises(UsageError, match="`test` and `holdout` both select the held-out views; allowed: one of them"):
        PhotographOptions(test="a", holdout=3).require()
    with pytest.raises(UsageError, match="`holdout` is 1; allowed: 2 or more"):
        PhotographOptions(holdout=1).require()


def test_pictures_that_show_no_object_or_nothing_else_are_said(tmp_path: Path, listener: Listener) -> None:
    """A mask or a rendering that failed empties all space that its camera sees."""
    capture = photographed(write_nerfstudio, tmp_path, many(6))
    read_photographs(listener, Source(str(capture)))
    assert not [line for line in listener.said if "alpha" in line]
    for number, alpha in ((1, 0), (2, 255), (4, 0), (5, 0)):
        pixels = spot(14, 10, number)
        pixels[..., 3] = alpha
        write_picture(capture / "images" / f"r_{number}.png", pixels)
    read_photographs(listener, Source(str(capture)))
    assert listener.said[-2:] == [
        f"{capture}: warning: images/r_1.png has alpha 0 everywhere (and 2 more): no object is where its camera looks",
        f"{capture}: warning: images/r_2.png has alpha 255 everywhere: all that it shows counts as the object",
    ]


def test_test_cameras_without_pictures_judge_nothing(tmp_path: Path, listener: Listener) -> None:
    """Blender add-ons write the cameras of both splits, but may render the training views alone."""
    capture = split_capture(tmp_path)
    shutil.rmtree(capture / "test")
    split = read_photographs(listener, Source(str(capture)))
    assert [camera.name for camera in split.held_out.cameras.cameras] == ["r_0"]
    assert len(split.training.pictures) == 4
    said = f"{capture}/transforms_test.json: has no pictures; one of every 8 training views is held out instead"
    assert said in listener.said
    with pytest.raises(InvalidFile, match=r"transforms_test.json: picture test/r_0 is not there; allowed"):
        read(capture, test=str(capture / "transforms_test.json"))


def test_masks_cut_the_object_out_of_scenery(tmp_path: Path) -> None:
    scenery = np.random.default_rng(0).integers(0, 256, (10, 14, 3), np.uint8)
    capture = photographed(write_nerfstudio, tmp_path / "capture", many(5), lambda pixels: scenery)
    with pytest.raises(InvalidScene, match=r"capture: the pictures show scenery behind the object: .* `masks=DIR`"):
        read(capture, scenery="drop")
    kept = read(capture)
    assert kept.training.scenery
    assert kept.held_out.scenery
    masks = tmp_path / "masks"
    mask = np.repeat(spot(14, 10)[..., 3:], 3, axis=2)
    for number, name in enumerate(("r_0.png", "r_1.jpg", "r_2.png.png", "images/r_3.png", "images/r_4.png.png")):
        write_picture(masks / name, mask)
        if number < 4:
            with pytest.raises(InvalidFile, match=rf"masks: mask r_{number + 1} is not there; allowed: .*"):
                read(capture, masks=str(masks))
    training = read(capture, masks=str(masks)).training
    assert training.masked
    assert training.rough
    used = read(capture, masks=str(masks), scenery="keep").training
    assert used.scenery
    assert_array_equal(used.used(0), spot(14, 10)[..., 3] == 255)
    for pixels in training.pictures:
        assert_array_equal(pixels[..., :3], scenery)
        assert_array_equal(pixels[..., 3], spot(14, 10)[..., 3])
    write_picture(masks / "r_1.jpg", mask[:-1])
    with pytest.raises(InvalidScene, match=r"masks/r_1\.jpg: the mask has 14x9 pixels; allowed: 14x10"):
        read(capture, masks=str(masks))
    with pytest.raises(InvalidFile, match=r"none: is not a folder; allowed: a folder with a mask for each picture"):
        read(capture, masks="none")


def test_masks_of_several_cameras_lie_as_their_pictures_do(tmp_path: Path) -> None:
    """COLMAP's masks of images/left/0.png are left/0.png.png: their folder stands for `images`."""
    made = many(6)
    write_colmap_text(tmp_path, made)
    images = tmp_path / "sparse" / "images.txt"
    text = images.read_text()
    for i in range(6):
        name = f"{('left', 'right')[i % 2]}/{i // 2}.png"
        text = text.replace(f" r_{i}.png", f" {name}")
        write_picture(tmp_path / "images" / name, spot(14, 10, i))
        mask = np.zeros((10, 14, 3), np.uint8)
        mask[:, : i + 1] = 255
        write_picture(tmp_path / "masks" / f"{name}.png", mask)
    images.write_text(text)
    training, held_out = read(tmp_path, masks=str(tmp_path / "masks"))
    for views in (training, held_out):
        for camera, pixels in zip(views.cameras.cameras, views.pictures, strict=True):
            side, number = camera.picture.removeprefix("images/").removesuffix(".png").split("/")
            i = 2 * int(number) + (side == "right")
            assert_array_equal(pixels[..., :3], spot(14, 10, i)[..., :3])
            assert (pixels[0, :, 3] == 255).sum() == i + 1
    flat = tmp_path / "flat"
    for i in range(3):
        write_picture(flat / f"{i}.png", np.full((10, 14, 3), 255, np.uint8))
    said = (
        r"flat: 0\.png is the mask of images/left/0\.png and of images/right/0\.png; allowed: a mask for each picture"
    )
    with pytest.raises(InvalidFile, match=said):
        read(tmp_path, masks=str(flat))


def test_a_plain_background_is_found_or_told(tmp_path: Path) -> None:
    capture = photographed(write_nsvf, tmp_path, many(5), lambda pixels: over(pixels, (9, 8, 7)))
    assert read(capture).training.background == (9 / 255, 8 / 255, 7 / 255)
    assert read(capture, background=(0.0, 0.0, 0.0)).held_out.background == (0.0, 0.0, 0.0)
    with pytest.raises(InvalidScene, match="only 0 % of their edges are near 255,255,255"):
        read(capture, background=(1.0, 1.0, 1.0))


@pytest.mark.parametrize("write", [write for write in DIALECTS if write is not write_llff])  # its poses name no picture
def test_cameras_without_a_picture_are_left_out_and_counted(
    write: Callable[..., Path], tmp_path: Path, listener: Listener
) -> None:
    path = photographed(write, tmp_path, many(6))
    for name in ("r_1", "r_4"):
        (picture,) = (file for file in tmp_path.rglob(f"{name}*") if is_picture(file))
        picture.unlink()
    training, held_out = read_photographs(listener, Source(str(path)), PhotographOptions(holdout=2))
    assert [camera.name for camera in training.cameras.cameras] == ["r_2", "r_5"]
    assert [camera.name for camera in held_out.cameras.cameras] == ["r_0", "r_3"]
    assert f"{path}: 2 of 6 cameras have no picture and are left out" in listener.said
    for views in (training, held_out):
        for camera, pixels in zip(views.cameras.cameras, views.pictures, strict=True):
            assert_array_equal(pixels, spot(camera.width, camera.height, int(camera.name[2:])))


def test_endings_may_be_in_another_case_than_the_files(tmp_path: Path) -> None:
    capture = photographed(write_nerfstudio, tmp_path, many(5))
    for name, ending in (("r_1", ".JPG"), ("r_2", ".jpeg"), ("r_3", ".JPEG"), ("r_4", ".jpg")):
        Pillow.open(capture / "images" / f"{name}.png").convert("RGB").save(
            capture / "images" / f"{name}{ending}", "JPEG"
        )
        (capture / "images" / f"{name}.png").unlink()
    (capture / "images" / "r_0.png").rename(capture / "images" / "r_0.PNG")
    path = capture / "transforms.json"
    text = path.read_text()
    for name in ("r_1", "r_2", "r_3", "r_4"):
        text = text.replace(f"{name}.png", f"{name}.jpg")
    path.write_text(text)
    split = read(capture)
    assert len(split.training.pictures) + len(split.held_out.pictures) == 5


def test_a_picture_that_lies_on_its_side_is_turned_only_to_fit_its_camera(tmp_path: Path) -> None:
    """EXIF's orientation 6: the stored rows run from the bottom of the scene to its top."""
    capture = photographed(write_nerfstudio, tmp_path, many(3))
    path = capture / "images" / "r_1.png"
    upright = Pillow.open(path)
    exif = Pillow.Exif()
    exif[0x0112] = 6
    stored = upright.transpose(Pillow.Transpose.ROTATE_90)
    stored.save(path, exif=exif)
    assert_array_equal(read(capture).training.pictures[0], np.asarray(upright))  # poses found on upright pictures
    upright.save(path, exif=exif)
    assert_array_equal(read(capture).training.pictures[0], np.asarray(upright))  # poses found on the stored pixels
    stored.save(path)
    with pytest.raises(InvalidScene, match=r"r_1\.png has 10x14 pixels; allowed: .* 14x10"):
        read(capture)


def gone(capture: Path) -> None:
    for name in ("r_1", "r_3", "r_4"):
        (capture / "images" / f"{name}.png").unlink()


def unreadable(capture: Path) -> None:
    (capture / "images" / "r_2.png").write_bytes(b"GIF89a")


def of_another_shape(capture: Path) -> None:
    write_picture(capture / "images" / "r_2.png", spot(10, 14))


def leading_out(capture: Path) -> None:
    write_picture(capture.parent / "r_2.png", spot(14, 10))
    edit(capture, lambda frame: frame | {"file_path": "../r_2.png"})


def of_a_fixed_place(capture: Path) -> None:
    edit(capture, lambda frame: frame | {"file_path": str(capture / "images" / "r_2.png")})


def without_a_name(capture: Path) -> None:
    edit(capture, lambda frame: {key: value for key, value in frame.items() if key != "file_path"})


def nowhere(capture: Path) -> None:
    edit(capture, lambda frame: frame | {"transform_matrix": [[1e999] * 4] * 4})


def nan(capture: Path) -> None:
    path = capture / "transforms.json"
    path.write_text(path.read_text().replace('"transform_matrix": [[', '"transform_matrix": [[NaN, ', 1))


def edit(capture: Path, change: Callable[[dict[str, Any]], dict[str, Any]]) -> None:
    path = capture / "transforms.json"
    fields = json.loads(path.read_text())
    fields["frames"][2] = change(fields["frames"][2])
    path.write_text(json.dumps(fields).replace("Infinity", "1e999"))


WRONG: dict[str, tuple[Callable[[Path], None], str]] = {
    "missing": (gone, r"capture: picture images/r_1\.png is not there; allowed: a PNG, a JPEG .* \(and 2 more\)$"),
    "unreadable": (unreadable, r"images/r_2\.png: the picture cannot be read .*; allowed: a whole PNG or JPEG$"),
    "of another shape": (of_another_shape, r"capture: picture images/r_2\.png has 10x14 pixels; allowed: .* 14x10$"),
    "leading out": (
        leading_out,
        r"capture: camera r_2 names no picture in the folder of the capture; allowed: a relative path, without \.\.",
    ),
    "of a fixed place": (of_a_fixed_place, r"capture: camera r_2 names no picture in the folder"),
    "without a name": (without_a_name, r"capture: camera 0002 names no picture in the folder"),
    "nowhere": (nowhere, r"capture: .*; allowed: "),
    "NaN": (nan, r"capture: frames\[0\]\.transform_matrix\[0, 0\] is NaN; allowed: a finite number$"),
}


@pytest.mark.parametrize("name", WRONG)
def test_what_is_wrong_is_one_line(name: str, tmp_path: Path) -> None:
    capture = photographed(write_nerfstudio, tmp_path / "capture", many(5))
    change, said = WRONG[name]
    change(capture)
    with pytest.raises(NerfbakeError, match=said) as found:
        read(capture)
    assert found.value.exit_code == 1


@pytest.mark.parametrize("count", [1, 2])
def test_too_few_views_are_refused(count: int, tmp_path: Path) -> None:
    capture = photographed(write_nerfstudio, tmp_path, many(count))
    with pytest.raises(
        InvalidFile, match=rf"the views are {count}, and one of every 8 is held out; allowed: 2 or more"
    ):
        read(capture)
    if count == 1:
        with pytest.raises(InvalidFile, match="the views are 1 to fit to and 1 held out; allowed: 2 or more"):
            read(capture, test=str(capture))


def test_pictures_count_as_memory_once_and_compressed(tmp_path: Path) -> None:
    made, rng = many(9), np.random.default_rng(0)
    capture = photographed(
        write_nerfstudio, tmp_path, Rig(140, 100, 175, 175, 70, 50, made.poses), lambda pixels: pixels
    )
    with memory_limit(1_000_000):
        split = read(capture)
        assert left() > 1_000_000 - 9 * 56_000 / 4
        del split
    for path in (capture / "images").iterdir():
        Pillow.fromarray(rng.integers(0, 256, (100, 140, 4), dtype=np.uint8)).save(path)  # cannot be compressed
    with memory_limit(1_000_000):
        split = read(capture)
        assert 1_000_000 - 9 * 56_000 - 30_000 < left() <= 1_000_000 - 9 * 56_000
        del split
    with memory_limit(400_000), pytest.raises(MemoryLimit, match=r"images/r_\d\.png: the picture needs .* in addition"):
        read(capture)


def test_large_pictures_are_reduced_with_their_masks(
    tmp_path: Path, listener: Listener, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("nerfbake.jobs.photographs.MOST_EDGE", 40)
    capture = photographed(write_nerfstudio, tmp_path, Rig(140, 100, 175, 175, 70, 50, many(9).poses))
    masks = tmp_path / "masks"
    masks.mkdir()
    for path in (capture / "images").iterdir():
        mask = Pillow.new("L", (140, 100))
        mask.paste(255, (30, 30, 91, 60))
        mask.save(masks / path.name)
    with memory_limit(600_000):
        split = read_photographs(listener, Source(str(capture)), PhotographOptions(masks=str(masks)))
        assert left() >= 600_000 - 9 * 46 * 33 * 4
    assert {picture.shape for picture in (*split.training.pictures, *split.held_out.pictures)} == {(33, 46, 4)}
    assert split.training.cameras.cameras[0].fx == pytest.approx(175 / 3)
    assert set(split.training.pictures[0][15, 8:34, 3].tolist()) == {0, 85, 255}
    said = "reduces large pictures, such as from 140x100 to 46x33 pixels, each the mean of 3x3"
    assert [line for line in listener.said if "reduces" in line] == [f"{capture}: {said}"]


def test_the_cores_read_pictures_and_the_first_broken_one_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("nerfbake.kernels.parallel.cores", lambda: 3)
    both, load_photograph, filters = Barrier(2), io.load_photograph, list(warnings.filters)

    def load_beside(path: Path, size: tuple[int, int]) -> Any:
        if path.stem in ("r_1", "r_2"):
            both.wait(10)
        return load_photograph(path, size)

    monkeypatch.setattr("nerfbake.io.load_photograph", load_beside)
    capture = photographed(write_nerf_synthetic, tmp_path, many(9))
    files = sorted(capture.rglob("*.png"))
    read(capture)
    assert warnings.filters == filters
    for file in files[3:6]:
        file.write_bytes(b"broken")
    with pytest.raises(InvalidFile, match=f"^{files[3]}: the picture cannot be read"):
        read(capture)


def test_a_name_that_is_too_long_is_named(tmp_path: Path) -> None:
    name = "x" * 300
    with pytest.raises(InvalidFile, match=f"{name}: File name too long"):
        read(name)
    capture = photographed(write_nerfstudio, tmp_path, many(5))
    with pytest.raises(InvalidFile, match=f"{name}: File name too long"):
        read(capture, masks=name)


def test_poses_of_llff_need_one_picture_each(tmp_path: Path) -> None:
    capture = photographed(write_llff, tmp_path, many(5))
    (capture / "images" / "._r_0.JPG").write_bytes(b"\0\5\x16\7")  # macOS writes these to drives of other systems
    assert len(read(capture).training.pictures) == 4
    (capture / "images" / "r_3.JPG").unlink()
    said = "images does not have one picture for each of the 5 poses; allowed: 5 PNG, JPEG or HEIC"
    with pytest.raises(InvalidFile, match=said):
        read(capture)


def test_a_picture_beside_the_cameras_file_is_found(tmp_path: Path) -> None:
    photographed(write_nerfstudio, tmp_path, many(5))
    (tmp_path / "transforms.json").rename(tmp_path / "mine.json")
    assert len(load(tmp_path / "mine.json", Cameras).cameras) == 5
    assert len(read(tmp_path / "mine.json").training.pictures) == 4
