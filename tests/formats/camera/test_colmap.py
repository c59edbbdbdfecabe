"""COLMAP models: no image is lost, no id is ambiguous, and of several models the largest is read."""

from __future__ import annotations

import json
import os
import struct
import subprocess
import sys
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

from nerfbake import Cameras, load
from nerfbake.errors import InvalidFile
from nerfbake.formats.camera import colmap
from nerfbake.scene.lens import Lens

CAMERA = "1 PINHOLE 4 3 5 5 2 1.5\n"
BOM = b"\xef\xbb\xbf"


def image(number: int, name: str = "", points: str = "\n") -> str:
    """The lines of an image in images.txt, taken by camera 1."""
    return f"{number} 1 0 0 0 0 0 0 1 {name or f'{number}.png'}\n{points}"


def write_text(folder: Path, images: str, cameras: str = CAMERA, start: bytes = b"") -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "cameras.txt").write_bytes(start + cameras.encode())
    (folder / "images.txt").write_bytes(start + images.encode())
    return folder


def write_binary(folder: Path, images: list[tuple[int, bytes]], cameras: list[tuple[int, int, Any]]) -> Path:
    """images: (id, name), taken by camera 1; cameras: (id, model, parameters)."""
    folder.mkdir(parents=True, exist_ok=True)
    pieces = [struct.pack("<Q", len(cameras))]
    pieces += [struct.pack(f"<IiQQ{len(each)}d", key, model, 4, 3, *each) for key, model, each in cameras]
    (folder / "cameras.bin").write_bytes(b"".join(pieces))
    pieces = [struct.pack("<Q", len(images))]
    pieces += [struct.pack("<I7dI", key, 1, *[0] * 6, 1) + name + bytes(9) for key, name in images]
    (folder / "images.bin").write_bytes(b"".join(pieces))
    return folder


def write_model(folder: Path, count: int) -> Path:
    """A binary model with this many images."""
    images = [(i, f"{i}.png".encode()) for i in range(count)]
    return write_binary(folder, images, [(1, 1, (5, 5, 2, 1.5))])


def names(path: Path) -> list[str]:
    return [camera.name for camera in load(path, Cameras).cameras]


@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_images_without_lines_of_points_are_refused(end: str, tmp_path: Path) -> None:
    # Every second image was taken for a line of points.
    write_text(tmp_path, "# a comment\n" + "".join(image(i, points="") for i in range(1, 4)).replace("\n", end))
    said = (
        r"images\.txt: line 3 is not the points of the image above, but 2 1 0 0 0 0 0 0 1 2\.png; allowed: x y id of "
    )
    with pytest.raises(InvalidFile, match=said):
        load(tmp_path, Cameras)


@pytest.mark.parametrize(
    "points",
    ["1.5 2.5 -1 4", "1 2 3 # three", "a " * 1000, "1.5 2.5 -1 " * 20 + "x", "# no points", "0 " * 400 + "x y z"],
)
def test_lines_that_are_not_points_are_refused(points: str, tmp_path: Path) -> None:
    write_text(tmp_path, image(1, points=points + "\n") + image(2))
    with pytest.raises(InvalidFile, match=r"images\.txt: line 2 is not the points"):
        load(tmp_path, Cameras)


@pytest.mark.parametrize("points", ["", " \r", "1.5 2.5 -1", "1.5 2.5 -1 " * 3, "1234.5678 -0.5e-3 17 " * 5000])
def test_lines_of_points_of_any_length_are_skipped(points: str, tmp_path: Path) -> None:
    write_text(tmp_path, image(1, points=points + "\n") + image(2, points=points + "\n") + image(3, points=""))
    assert names(tmp_path) == ["1", "2", "3"]


def test_a_byte_order_mark_is_skipped(tmp_path: Path) -> None:
    assert names(write_text(tmp_path / "a", image(1) + image(2), start=BOM)) == ["1", "2"]
    assert names(write_text(tmp_path / "b", "# 1\n" + image(1), "# 1\n" + CAMERA, start=BOM)) == ["1"]


def test_names_keep_their_spaces(tmp_path: Path) -> None:
    spaced = ["a  b.png", "Screenshot 3.45\u202fPM.png", "images of a/c d.png"]
    write_text(tmp_path, "".join(image(i, name) for i, name in enumerate(spaced)))
    pictures = {camera.picture for camera in load(tmp_path, Cameras).cameras}
    assert pictures == {f"images/{name}" for name in spaced}


PINHOLES = (1, 1, (5, 5, 2, 1.5)), (1, 1, (9, 9, 2, 1.5))  # two cameras with the same id
REPEATED: dict[str, tuple[Callable[[Path], Path], str]] = {
    "a camera, text": (lambda at: write_text(at, image(1), CAMERA * 2), "cameras.txt: camera id 1 occurs 2 times"),
    "a camera": (lambda at: write_binary(at, [(1, b"a")], [*PINHOLES]), "cameras.bin: camera id 1 occurs 2 times"),
    "an image, text": (lambda at: write_text(at, image(7, "a") + image(7, "b")), "images.txt: image id 7 occurs 2"),
    "an image": (
        lambda at: write_binary(at, [(7, b"a"), (7, b"b"), (7, b"c")], [PINHOLES[0]]),
        "images.bin: image id 7 occurs 3 times; allowed: each once",
    ),
    "a name, text": (lambda at: write_text(at, image(1, "my b") + image(2, "my b")), "images.txt: image name my b occ"),
    "a name": (
        lambda at: write_binary(at, [(1, b"a.png"), (2, b"a.png")], [PINHOLES[0]]),
        "images.bin: image name a.png occurs 2 times; allowed: each once",
    ),
}


@pytest.mark.parametrize("name", REPEATED)
def test_what_is_listed_twice_is_refused(name: str, tmp_path: Path) -> None:
    write, said = REPEATED[name]
    with pytest.raises(InvalidFile) as found:
        load(write(tmp_path), Cameras)
    assert said in str(found.value)


def test_names_that_are_not_text_may_look_equal(tmp_path: Path) -> None:
    assert len(names(write_binary(tmp_path, [(1, b"\xff.png"), (2, b"\xfe.png")], [PINHOLES[0]]))) == 2


def test_fisheyes_without_coefficients_by_hand(tmp_path: Path) -> None:
    write_binary(tmp_path / "a", [(1, b"a")], [(1, 14, (2, 1.5, 1.5))])
    write_binary(tmp_path / "b", [(1, b"a")], [(1, 15, (2, 3, 1.5, 1.5))])
    write_text(tmp_path / "c", image(1), "1 SIMPLE_FISHEYE 4 3 2 1.5 1.5\n")
    write_text(tmp_path / "d", image(1), "1 FISHEYE 4 3 2 3 1.5 1.5\n")
    for folder, fy in (("a", 2), ("b", 3), ("c", 2), ("d", 3)):
        (camera,) = load(tmp_path / folder, Cameras).cameras
        assert (camera.fx, camera.fy, camera.lens) == (2, fy, Lens("fisheye"))
        # The centre of pixel (3, 1) is 2 pixels to the right of the axis: theta = 2 / f = 1.
        assert_allclose(camera.rays()[1].reshape(3, 4, 3)[1, 3], [np.sin(1), 0, np.cos(1)], atol=1e-12)


@pytest.mark.slow
def test_pycolmap_has_these_models_and_projects_our_rays_to_the_pixels(tmp_path: Path) -> None:
    # In a process of its own: pycolmap and Pillow in one process have aborted with a corrupted heap.
    if find_spec("pycolmap") is None:
        pytest.skip("needs pycolmap")
    write_binary(tmp_path / "SIMPLE_FISHEYE", [(1, b"a")], [(1, 14, (3, 1.7, 1.2))])
    write_binary(tmp_path / "FISHEYE", [(1, b"a")], [(1, 15, (3, 4, 1.7, 1.2))])
    sent: dict[str, Any] = {}
    for name in ("SIMPLE_FISHEYE", "FISHEYE"):
        (camera,) = load(tmp_path / name, Cameras).cameras
        sent[name] = (camera.rays()[1] @ camera.pose[:3, :3] * [1, -1, -1]).tolist()  # COLMAP's axes of the camera
    code = """if True:
        import json, sys
        import numpy as np, pycolmap
        sent = json.load(sys.stdin)
        make = pycolmap.Camera.create_from_model_name
        models = {name: kind for name, kind in pycolmap.CameraModelId.__members__.items() if name != "INVALID"}
        sizes = {int(kind): [name, len(make(1, name, 5.0, 4, 3).params)] for name, kind in models.items()}
        seen = {}
        for name, points in sent.items():
            model = pycolmap.Reconstruction(name).cameras[1]
            seen[name] = model.img_from_cam(np.array(points)).tolist()
        json.dump([sizes, seen], sys.stdout)"""
    for name in sent:
        (tmp_path / name / "points3D.bin").write_bytes(bytes(8))
    done = subprocess.run(
        [sys.executable, "-c", code],
        input=json.dumps(sent),
        cwd=tmp_path,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        check=True,
    )
    sizes, seen = json.loads(done.stdout)
    assert {int(number): tuple(model) for number, model in sizes.items()} == colmap.MODELS
    centres = np.stack(np.meshgrid(np.arange(4) + 0.5, np.arange(3) + 0.5), axis=-1).reshape(-1, 2)
    for name, pixels in seen.items():
        assert_allclose(pixels, centres, atol=1e-9, err_msg=name)


def test_the_largest_of_several_models_is_read_and_said(tmp_path: Path) -> None:
    # nerfstudio#2410, brush#416: sparse/0 may be a small part of the capture.
    for number, count in enumerate((2, 5, 5, 1)):
        write_model(tmp_path / f"sparse/{number}", count)
    cameras = load(tmp_path, Cameras)
    assert (cameras.source, len(cameras.cameras)) == ("sparse/1/images.bin", 5)
    assert cameras.notes == ("using sparse/1, the largest of 4 COLMAP models, with 5 images",)
    for path, count in (("sparse/0", 2), ("sparse/3/images.bin", 1)):  # what the user names is read
        named = load(tmp_path / path, Cameras)
        assert (len(named.cameras), named.notes) == (count, ())


def test_the_largest_may_be_text_and_the_numbers_may_have_gaps(tmp_path: Path) -> None:
    write_model(tmp_path / "colmap/sparse/0", 2)
    write_text(tmp_path / "colmap/sparse/3", "".join(image(i) for i in range(3)))
    cameras = load(tmp_path, Cameras)
    assert (cameras.source, len(cameras.cameras)) == ("colmap/sparse/3/images.txt", 3)
    assert cameras.notes == ("using colmap/sparse/3, the largest of 2 COLMAP models, with 3 images",)


def test_a_single_model_is_said_only_if_it_is_not_the_first(tmp_path: Path) -> None:
    write_model(tmp_path / "a/sparse/0", 1)
    write_model(tmp_path / "b/sparse/1", 1)
    assert load(tmp_path / "a", Cameras).notes == ()
    assert load(tmp_path / "b", Cameras).notes == ("using sparse/1, the only COLMAP model, with 1 image",)


def test_the_other_models_are_not_read(tmp_path: Path) -> None:
    write_model(tmp_path / "sparse/0", 3)
    write_model(tmp_path / "sparse/1", 2)
    (tmp_path / "sparse/1/images.bin").write_bytes(struct.pack("<Q", 2))
    (tmp_path / "sparse/1/cameras.bin").write_bytes(b"")
    assert len(load(tmp_path, Cameras).cameras) == 3
