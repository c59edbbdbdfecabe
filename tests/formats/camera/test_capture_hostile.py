"""What captures must not get away with: one line, soon, in little memory."""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from nerfbake import Cameras, load, memory_limit
from nerfbake.errors import MemoryLimit, NerfbakeError
from tests.support.captures import rig, write_colmap_binary, write_colmap_text, write_llff, write_nsvf
from tests.support.hostile import damaged

MODEL = "1 PINHOLE 4 3 5 5 2 1.5\n"
SHOT = "1 1 0 0 0 0 0 0 1 a.png\n\n"

COLMAP_TEXT = {
    "an unknown model": (MODEL.replace("PINHOLE", "CUBE"), SHOT, "line 1 has model CUBE; allowed: SIMPLE_PINHOLE"),
    "a sphere of no size": ("1 EQUIRECTANGULAR 4 3 0 3\n", SHOT, "has focal length 0; allowed: 1e-06"),
    "thin prisms": ("1 THIN_PRISM_FISHEYE 4 3 5 5 2 1 0 0 0 0 0 0 9e9 0\n", SHOT, "s1 is 9e+09; allowed: -1e+06"),
    "too few parameters": ("1 PINHOLE 4 3 5\n", SHOT, "line 1 has 1 parameters; allowed: 4 for PINHOLE"),
    "a short line": ("1 PINHOLE\n", SHOT, "line 1 has 2 entries; allowed: 5 or more"),
    "no number": (MODEL.replace("1.5", "nan"), SHOT, "line 1 holds a value that is not a number"),
    "text for a number": (MODEL.replace("1.5", "x"), SHOT, "line 1 holds a value that is not a number"),
    "half a pixel": (MODEL.replace("4 3", "4.5 3"), SHOT, "line 1 has 4.5; allowed: a whole number"),
    "too large": (MODEL.replace("4 3", "99999 3"), SHOT, "camera 1 has 99,999x3 pixels"),
    "nobody's camera": (MODEL, SHOT.replace("1 a.png", "7 a.png"), "image a was taken by camera 7"),
    "no rotation": (MODEL, SHOT.replace("1 1 0 0 0", "1 0 0 0 0"), "image a has the quaternion"),
    "a huge rotation": (MODEL, SHOT.replace("1 1 0 0 0", "1 1e300 0 0 0"), "image a has the quaternion"),
    "far away": (MODEL, SHOT.replace("0 0 0 1 a", "1e300 0 0 1 a"), "image a has the shift"),
    "no images": (MODEL, "# none\n", "the frames are 0; allowed: 1 to 100,000"),
    "an endless line": (MODEL, SHOT.replace("a.png", "a" * 99_999), "has 100,0"),
}  # fmt: skip


@pytest.mark.parametrize("name", COLMAP_TEXT)
def test_a_lying_text_model_is_refused(name: str, tmp_path: Path) -> None:
    cameras, images, said = COLMAP_TEXT[name]
    (tmp_path / "cameras.txt").write_text(cameras)
    (tmp_path / "images.txt").write_text(images)
    with pytest.raises(NerfbakeError) as found:
        load(tmp_path, Cameras)
    assert said in str(found.value)
    assert "allowed" in str(found.value)


BINARY: dict[str, tuple[str, Callable[[bytes], bytes], str]] = {
    "2^64 cameras": ("cameras", lambda data: b"\xff" * 8 + data[8:], "counts 18,446,744,073,709,551,615"),
    "2^64 images": ("images", lambda data: b"\xff" * 8 + data[8:], "counts 18,446,744,073,709,551,615"),
    "one too many": ("images", lambda data: struct.pack("<Q", 4) + data[8:], "ends after"),
    "an unknown model": ("cameras", lambda data: data[:12] + b"\x12" + data[13:], "model 18; allowed: 0 to 17"),
    "a model below 0": ("cameras", lambda data: data[:12] + b"\xff" * 4 + data[16:], "camera 3 has model -1"),
    "a name without an end": ("images", lambda data: data[:72] + b"a" * 5000, "has a name without NUL at byte 72"),
    "2^64 points": ("images", lambda data: data[:-8] + b"\xff" * 8, "ends after"),
    "nothing": ("images", lambda data: b"", "ends after 0 bytes"),
}  # fmt: skip


@pytest.mark.parametrize("name", BINARY)
def test_a_lying_binary_model_is_refused(name: str, tmp_path: Path) -> None:
    which, change, said = BINARY[name]
    path = write_colmap_binary(tmp_path, rig(odd=True)) / "sparse" / "0" / f"{which}.bin"
    path.write_bytes(change(path.read_bytes()))
    with pytest.raises(NerfbakeError) as found:
        load(tmp_path, Cameras)
    assert said in str(found.value)


def llff(shape: tuple[int, ...] = (3, 17), value: Any = 1.0, dtype: Any = np.float64) -> Any:
    rows = np.full(shape, value, dtype)
    return lambda folder: np.save(folder / "poses_bounds.npy", rows)


def shared_of_four(folder: Path) -> None:
    np.save(folder / "poses_bounds.npy", np.ones((3, 14)))
    np.save(folder / "hwf_cxcy.npy", np.ones(4))


LLFF = {
    "another shape": (llff((3, 12)), "poses_bounds.npy has shape (3, 12); allowed: (n, 17)"),
    "one pose": (llff((17,)), "poses_bounds.npy has shape (17,)"),
    "no pose": (llff((0, 17)), "the frames are 0"),
    "NaN": (llff(value=np.nan), "holds a number that is not finite or too large"),
    "1e308": (llff(value=1e308), "holds a number that is not finite or too large"),
    "a flat pose": (llff(), "has a singular pose"),
    "text": (llff(value="a", dtype="U1"), "declares"),
    "an object": (lambda folder: np.save(folder / "poses_bounds.npy", np.array([{}], object)), "holds Python objects"),
    "no shared lens": (llff((3, 14)), "hwf_cxcy.npy is missing"),
    "a shared lens of four": (shared_of_four, "hwf_cxcy.npy has shape (4,)"),
    "no array": (lambda folder: (folder / "poses_bounds.npy").write_bytes(b"text"), "starts with"),
    "an empty file": (lambda folder: (folder / "poses_bounds.npy").write_bytes(b""), "starts with"),
}  # fmt: skip


@pytest.mark.parametrize("name", LLFF)
def test_lying_poses_are_refused(name: str, tmp_path: Path) -> None:
    write, said = LLFF[name]
    write(tmp_path)
    with pytest.raises(NerfbakeError) as found:
        load(tmp_path, Cameras)
    assert said in str(found.value)


NSVF = {
    "no number": ("intrinsics.txt", "a b c", "intrinsics.txt holds a value that is not a number"),
    "skew": ("intrinsics.txt", "5 1 2\n0 5 2\n0 0 1\n", "intrinsics.txt: skew is 1; allowed: 0"),
    "two numbers": ("intrinsics.txt", "5 5\n", "intrinsics.txt has lines of no numbers"),
    "NaN": ("intrinsics.txt", "nan 1 2 3\n", "holds a number that is not finite or too large"),
    "a negative focal length": ("intrinsics.txt", "-5 1 2 3\n", "has focal length -5"),
    "a short pose": ("pose/r_1.txt", "1 0 0 0\n", "pose/r_1.txt has 4 numbers; allowed: 4 x 4"),
    "a large file": ("pose/r_1.txt", "1 " * 99_999, "pose/r_1.txt has 199,998 bytes"),
    "no text": ("pose/r_1.txt", "\udcff", "pose/r_1.txt holds a value that is not a number"),
}  # fmt: skip


@pytest.mark.parametrize("name", NSVF)
def test_lying_captures_are_refused(name: str, tmp_path: Path) -> None:
    file, text, said = NSVF[name]
    (write_nsvf(tmp_path, rig(odd=False)) / file).write_text(text, errors="surrogateescape")
    with pytest.raises(NerfbakeError) as found:
        load(tmp_path, Cameras)
    assert said in str(found.value)


def test_a_model_without_its_other_half_is_refused(tmp_path: Path) -> None:
    write_colmap_text(tmp_path, rig(odd=True))
    (tmp_path / "sparse" / "cameras.txt").unlink()
    with pytest.raises(NerfbakeError, match="the model is incomplete; allowed: cameras and images"):
        load(tmp_path / "sparse" / "images.txt", Cameras)
    with pytest.raises(NerfbakeError, match=r"is a folder of unknown kind; allowed: .* sparse/0/images\.bin"):
        load(tmp_path, Cameras)


def test_cameras_count_as_memory(tmp_path: Path) -> None:
    poses = np.zeros((60_000, 17))
    poses[:, [0, 6, 12]] = 1
    poses[:, [4, 9, 14]] = 4, 4, 4
    np.save(tmp_path / "poses_bounds.npy", poses)
    with memory_limit(60 << 20), pytest.raises(MemoryLimit, match="60,000 cameras needs"):
        load(tmp_path, Cameras)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("write", "file"),
    [
        (write_colmap_binary, "sparse/0/cameras.bin"),
        (write_colmap_binary, "sparse/0/images.bin"),
        (write_colmap_text, "sparse/cameras.txt"),
        (write_colmap_text, "sparse/images.txt"),
        (write_llff, "poses_bounds.npy"),
        (write_nsvf, "intrinsics.txt"),
        (write_nsvf, "pose/r_1.txt"),
    ],
)
def test_damaged_captures(write: Any, file: str, tmp_path: Path) -> None:
    """Cut at every 1 %, and 300 bits flipped: cameras with rays that are numbers, or one line."""
    path = write(tmp_path, rig(odd=False)) / file
    good = path.read_bytes()
    for what, data in damaged(good, flips=300):
        path.write_bytes(data)
        try:
            cameras = load(tmp_path, Cameras)
            for camera in cameras.cameras:
                if camera.width * camera.height < 1e5 and not camera.lens_problems():
                    assert np.isfinite(camera.rays()[1]).all(), what
        except NerfbakeError:
            continue
