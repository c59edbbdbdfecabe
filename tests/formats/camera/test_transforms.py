"""transforms.json in every spelling, and what it must not get away with."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from PIL import Image as Pillow

from nerfbake import load
from nerfbake.catalog import format_of_content
from nerfbake.errors import InvalidFile, InvalidScene
from nerfbake.formats.camera import transforms as cameras_json
from nerfbake.formats.camera.capture import PictureSizes
from nerfbake.io.sources import Folder
from nerfbake.scene.camera import Camera, Cameras
from nerfbake.scene.lens import Lens

EYE = np.eye(4).tolist()


def capture(**fields: Any) -> dict[str, Any]:
    frames = [{"file_path": "./train/r_7", "transform_matrix": EYE}]
    return {"camera_angle_x": 0.7, "frames": frames} | fields


def framed(**fields: Any) -> dict[str, Any]:
    """Two frames, the second with these fields of its own."""
    return capture(w=64, h=48, frames=[{"transform_matrix": EYE}, {"transform_matrix": EYE, **fields}])


def placed(x: Any) -> list[list[Any]]:
    """A pose with this x."""
    return [[1, 0, 0, x], *EYE[1:]]


def read(fields: Any) -> Cameras:
    return cameras_json.decode(memoryview(json.dumps(fields).encode()))


def test_a_capture_by_hand() -> None:
    cameras = read(capture())
    (camera,) = cameras.cameras
    assert (camera.width, camera.height, camera.name) == (800, 800, "r_7")
    assert_allclose(camera.fx, 400 / np.tan(0.35))
    assert cameras.notes == (
        "no size and no picture for 1 of its cameras; using 800x800, the size of the Blender scenes",
    )
    cameras = read(capture(w=640, h=480, fl_x=500))
    (camera,) = cameras.cameras
    assert (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy) == (640, 480, 500, 500, 320, 240)
    assert cameras.notes == ()


def test_samples_are_read_and_written() -> None:
    plain, four = read(capture()), read(capture(samples=2))
    assert (plain.samples, four.samples) == (1, 2)
    files = [json.loads(b"".join(cameras_json.encode(cameras))) for cameras in (plain, four)]
    assert "samples" not in files[0]  # as files were before there was such a key
    assert files[1] == {"samples": 2, **files[0]}
    assert read(files[1]).samples == 2


@pytest.mark.parametrize("samples", [0, -1, 9, 2.0, 10**30, "2", True, [2]])
def test_samples_that_are_none_are_refused(samples: Any) -> None:
    with pytest.raises(InvalidFile, match=r"samples is .*; allowed: a whole number from 1 to 8"):
        read(capture(samples=samples))


def test_what_is_written_is_read() -> None:
    cameras = read(capture(w=640, h=480, fl_x=500))
    data = b"".join(cameras_json.encode(cameras))
    again = cameras_json.decode(memoryview(data))
    assert_array_equal(again.cameras[0].pose, cameras.cameras[0].pose)
    assert again.cameras[0].fx == 500
    # What nerfstudio insists on stands there, once for all.
    written = json.loads(data)
    assert {key: written[key] for key in ("w", "h", "fl_x", "fl_y", "cx", "cy")} == {
        **{"w": 640, "h": 480, "fl_x": 500, "fl_y": 500, "cx": 320, "cy": 240}
    }
    assert "camera_model" not in written
    assert_allclose(written["camera_angle_x"], 2 * np.arctan(320 / 500))
    # A program that knows no more than an angle must not take it for the whole truth.
    for more in ({"cx": 300}, {"fl_y": 400}, {"k1": 0.1}):
        (data,) = cameras_json.encode(read(capture(w=640, h=480, fl_x=500, **more)))
        assert "camera_angle_x" not in json.loads(data)


def test_the_path_of_a_picture_is_written() -> None:
    made = Cameras((Camera(4, 3, 5.0, np.eye(4), "a", picture="images/a.jpg"), Camera(4, 3, 5.0, np.eye(4), "b")))
    (data,) = cameras_json.encode(made)
    assert [frame["file_path"] for frame in json.loads(data)["frames"]] == ["images/a.jpg", "b"]


def test_cameras_of_different_kinds_are_written_each_with_its_own() -> None:
    cameras = read(framed(fl_x=70.5, fl_y=71.25, cx=30, cy=25, k1=0.1, p2=-0.01, w=62))
    data = b"".join(cameras_json.encode(cameras))
    assert set(json.loads(data)) == {"frames"}
    for one, other in zip(cameras.cameras, cameras_json.decode(memoryview(data)).cameras, strict=True):
        assert (one.fx, one.fy, one.cx, one.cy, one.lens) == (other.fx, other.fy, other.cx, other.cy, other.lens)
        assert (one.width, one.height) == (other.width, other.height)


@pytest.mark.parametrize("lens", [Lens("fisheye", (0.1,)), Lens("equirectangular"), Lens("polynomial", (0.1,))])
def test_a_model_that_all_cameras_share_is_where_nerfstudio_reads_it(lens: Lens) -> None:
    """Beside the frames: nerfstudio 1.1.5 takes fisheyes for perspective if only their frames have a camera_model."""
    sizes = ((40, 20), (60, 30))
    made = Cameras(tuple(Camera(w, h, (w / 2 / np.pi, h / np.pi), np.eye(4), str(w), None, lens) for w, h in sizes))
    (data,) = cameras_json.encode(made)
    written = json.loads(data)
    assert written["camera_model"] in ("OPENCV_FISHEYE", "EQUIRECTANGULAR", "OPENCV")
    assert {frame["camera_model"] for frame in written["frames"]} == {written["camera_model"]}
    assert [camera.lens for camera in cameras_json.decode(memoryview(data)).cameras] == [lens, lens]
    pinhole = Camera(40, 20, 20.0, np.eye(4), "pinhole")
    (data,) = cameras_json.encode(Cameras((*made.cameras, pinhole)))
    assert "camera_model" not in json.loads(data)
    assert [camera.lens for camera in cameras_json.decode(memoryview(data)).cameras] == [lens, lens, None]


def test_the_middle_of_the_middle_pixel_looks_ahead() -> None:
    (camera,) = read(capture(w=5, h=3)).cameras
    place, directions = camera.rays()
    assert_allclose(place, 0)
    assert_allclose(directions[7], [0, 0, -1], atol=1e-12)
    assert directions[0][0] < 0 < directions[0][1]  # the first pixel: to the left, and up


@pytest.mark.parametrize(
    ("own", "expected"),
    [
        ({"fl_x": 50}, (50, 50, 32, 24, 64, 48)),  # the frame's own focal length is that of both axes
        ({"fl_x": 50, "fl_y": 40, "cx": 30.5, "cy": 20}, (50, 40, 30.5, 20, 64, 48)),
        ({"fl_y": 40}, (40, 40, 32, 24, 64, 48)),
        ({"x_fov": 90, "fl_x": 1, "camera_angle_x": 1}, (32, 32, 32, 24, 64, 48)),  # degrees first, as instant-ngp
        ({"x_fov": 90, "y_fov": 90}, (32, 24, 32, 24, 64, 48)),
        ({"camera_angle_y": np.pi / 2}, (24, 24, 32, 24, 64, 48)),
        ({"w": 32.0, "h": 32.0, "x_fov": 90}, (16, 16, 16, 16, 32, 32)),
    ],
)
def test_a_frames_own_fields_count(own: dict[str, Any], expected: tuple[float, ...]) -> None:
    first, second = read(framed(**own)).cameras
    assert_allclose(first.fx, 32 / np.tan(0.35))
    found = (second.fx, second.fy, second.cx, second.cy, second.width, second.height)
    assert_allclose(found, expected, rtol=1e-12)


def test_coefficients_as_text_are_read() -> None:
    # As nerfstudio's `ns-process-data realitycapture` copies them from a .csv.
    frame = {
        "transform_matrix": EYE,
        "fl_x": 50,
        "k1": "-0.02",
        "k2": "1e-3",
        "k3": "0",
        "k4": "0",
        "p1": "0",
        "p2": "0",
    }
    (camera,) = read(capture(w=64, h=48, camera_model="OPENCV", frames=[frame])).cameras
    assert camera.lens == Lens("polynomial", (-0.02, 0.001))


def test_lenses_that_bend_nothing_are_pinholes() -> None:
    zeros = dict.fromkeys(("k1", "k2", "k3", "k4", "p1", "p2"), 0)
    for fields in (zeros, {"camera_model": "OPENCV"}, {"camera_model": "PINHOLE", **zeros}, {"is_fisheye": False}):
        assert read(capture(w=4, h=3, **fields)).cameras[0].lens is None
    (camera,) = read(capture(w=4, h=3, is_fisheye=True, **zeros)).cameras
    assert camera.lens == Lens("fisheye")


def test_a_moving_camera_stands_where_it_starts() -> None:
    there = np.eye(4)
    there[0, 3] = 1
    frame = {"transform_matrix_start": EYE, "transform_matrix_end": there.tolist()}
    (camera,) = read(capture(w=4, h=3, frames=[frame])).cameras
    assert_array_equal(camera.pose, np.eye(4))
    read(capture(w=4, h=3, frames=[frame], rolling_shutter=[0, 0, 0, 0]))
    with pytest.raises(InvalidFile, match=r"frames\[0\].transform_matrix_end is combined with a rolling_shutter"):
        read(capture(w=4, h=3, frames=[frame], rolling_shutter=[0, 0, 0.1, 0]))


def test_sizes_are_the_pictures_own(tmp_path: Path) -> None:
    for name, size, kind in (("a.png", (30, 20), "PNG"), ("b.JPG", (20, 30), "JPEG"), ("c", (9, 9), "PNG")):
        Pillow.new("RGB", size).save(tmp_path / name, kind)
    (tmp_path / "broken.png").write_bytes(b"\x89PNG\r\n\x1a\n")
    (tmp_path.parent / "outside.png").write_bytes((tmp_path / "c").read_bytes())
    paths = [
        "a.png",
        ".\\a.png",
        "./b",
        "c",
        "none",
        "../outside.png",
        str(tmp_path / "c"),
        "broken",
        "a\0",
        "x" * 5000,
        "x" * 300,
        "x" * 300 + "/a.png",
    ]
    frames = [{"file_path": path, "transform_matrix": EYE} for path in paths]
    (tmp_path / "t.json").write_text(json.dumps(capture(frames=frames)))
    cameras = load(tmp_path / "t.json", Cameras)
    sizes = [(camera.width, camera.height) for camera in cameras.cameras]
    assert sizes[:4] == [(30, 20), (30, 20), (20, 30), (9, 9)]
    assert sizes[4:] == [(30, 20)] * 8  # what cannot be found or read is as large as the first
    assert cameras.notes == (
        "no size and no readable picture for 8 of its cameras (broken.png cannot be read); using 30x20, "
        "the size of the first picture",
    )


def padded(picture: bytes, segments: int) -> bytes:
    """A JPEG with this many segments of 65,000 bytes before its size, as phones write a depth map in extended XMP."""
    segment = b"http://ns.adobe.com/xmp/extension/\0" + bytes(65_000)
    return picture[:2] + (b"\xff\xe1" + (len(segment) + 2).to_bytes(2, "big") + segment) * segments + picture[2:]


def test_the_size_of_a_picture_may_follow_megabytes(tmp_path: Path) -> None:
    Pillow.new("RGB", (40, 30)).save(tmp_path / "a.jpg")
    Pillow.new("RGB", (40, 30)).save(tmp_path / "b.png", icc_profile=np.random.default_rng(0).bytes(600_000))
    (tmp_path / "a.jpg").write_bytes(padded((tmp_path / "a.jpg").read_bytes(), 50))
    frames = [{"file_path": path, "transform_matrix": EYE} for path in ("a.jpg", "b.png")]
    (tmp_path / "t.json").write_text(json.dumps(capture(frames=frames)))
    cameras = load(tmp_path / "t.json", Cameras)
    assert [(camera.width, camera.height) for camera in cameras.cameras] == [(40, 30)] * 2
    assert cameras.notes == ()


def test_only_the_start_of_other_files_is_read(tmp_path: Path) -> None:
    class Files(Folder):
        def head(self, name: str, size: int) -> bytes:
            sizes.append(size)
            return super().head(name, size)

    sizes: list[int] = []
    (tmp_path / "a.exr").write_bytes(bytes(1 << 20))
    assert PictureSizes(Files(tmp_path, {})).of("a.exr") is None
    assert sizes == [1 << 18]


def test_null_counts_as_absent() -> None:
    keys = ("k1", "p2", "k5", "cx", "cy", "fl_y", "x_fov", "camera_model", "is_fisheye", "distortion_params", "samples")
    (camera,) = read(capture(w=64, h=48, fl_x=50, **dict.fromkeys(keys))).cameras
    assert (camera.fx, camera.fy, camera.cx, camera.cy, camera.lens) == (50, 50, 32, 24, None)
    second = read(framed(transform_matrix_start=None, fl_x=None, k1=None, w=None)).cameras[1]
    assert (second.width, second.lens) == (64, None)
    assert_allclose(second.fx, 32 / np.tan(0.35))
    assert read(capture(w=None, h=None)).notes != ()


def test_a_byte_order_mark_is_skipped() -> None:
    data = b"\xef\xbb\xbf" + json.dumps(capture()).encode()
    assert cameras_json.recognise(memoryview(data))
    assert format_of_content("", memoryview(data)).name == "json"
    assert cameras_json.decode(memoryview(data)).cameras[0].name == "r_7"


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ([], "holds a list"),
        (capture(frames=[]), "frames are 0; allowed: 1 to 100,000"),
        (capture(frames={}), "frames are not a list"),
        ({"camera_path": [], "fl_x": 5}, "frames are missing; allowed: 1 to 100,000 frames"),
        (capture(frames=[{}]), r"frames\[0\].transform_matrix is missing; allowed: 4 x 4 numbers"),
        (capture(frames=[{"transform_matrix": np.diag([1, 1, 0, 1]).tolist()}]), "singular"),
        (capture(frames=[{"transform_matrix": [[1, 2], [3]]}]), "not a table of numbers"),
        (capture(frames=[{"transform_matrix": np.full((4, 4), 1e308).tolist()}]), r"transform_matrix.*1e\+15"),
        (capture(frames=[{"transform_matrix": np.eye(3).tolist()}]), "has shape"),
        (capture(frames=[{"transform_matrix": placed("1.5")}]), r"frames\[0\].transform_matrix\[0, 3\] is text; allow"),
        (
            capture(frames=[{"transform_matrix": placed(True)}]),
            r"transform_matrix\[0, 3\] is true or false; allowed: a",
        ),
        (capture(frames=[{"transform_matrix": placed(None)}]), r"frames\[0\].transform_matrix\[0, 3\] is null; allow"),
        (capture(frames=[3]), r"frames\[0\] is a number"),
        (capture(camera_angle_x=0), "camera_angle_x is 0"),
        (capture(camera_angle_x=4), "camera_angle_x is 4"),
        (capture(camera_angle_x=5e-324), "camera_angle_x is 4.940656e-324; allowed: radians between 0 and pi"),
        (capture(camera_angle_x="wide"), "camera_angle_x is wide"),
        (capture(camera_angle_x=None), "camera_angle_x is missing"),
        (capture(x_fov=200), "x_fov is 200; allowed: degrees between 0 and 180"),
        (capture(w=-3, h=3), "w is -3"),
        (capture(w=640), "h is missing"),
        (capture(w=640.5, h=480), "w is 640.5; allowed: a whole number of pixels"),
        (capture(w=1e8, h=1), "w is 100000000.0; allowed: a number from 1 to 16384"),
        (capture(w=4, h=3, fl_x=0), "fl_x is 0; allowed: a number from 1e-06 to 1e"),
        (capture(w=4, h=3, fl_x=True), "fl_x is True"),
        (capture(w=4, h=3, cx="middle"), "cx is middle"),
        (capture(w=4, h=3, k1=[1]), "k1 is a list"),
        (capture(w=4, h=3, k1="some"), "k1 is some; allowed: a number"),
        (capture(w=4, h=3, k1="nan"), "k1 is nan; allowed: a number"),
        (capture(w=4, h=3, k4=0.1), "k4 is 0.1; allowed: 0, or a camera_model that defines"),
        (capture(w=4, h=3, k5=0.1), "k5 is 0.1; allowed: 0, or camera_model FULL_OPENCV"),
        (capture(w=4, h=3, k1=1e9), r"k1 is 1e\+09; allowed: -1e\+06 to 1e\+06"),
        (capture(w=4, h=3, is_fisheye=True, p1=0.1), "p1, p2 are set for a fisheye lens"),
        (capture(w=4, h=3, is_fisheye=True, camera_model="OPENCV"), "is_fisheye is true"),
        (capture(w=4, h=3, is_fisheye="yes"), "is_fisheye is yes"),
        (capture(w=4, h=3, camera_model="ORTHOPHOTO"), "camera_model is ORTHOPHOTO; allowed: SIMPLE_PINHOLE"),
        (capture(w=4, h=3, camera_model=["OPENCV"]), "camera_model is a list"),
        (capture(w=4, h=3, distortion_params=[0.1]), "distortion_params is not a list of 6"),
        (capture(w=4, h=3, latlong=True), "latlong is True; allowed: perspective"),
        (capture(w=4, h=3, ftheta_p1=0.1), "ftheta_p1 is 0.1"),
        (capture(w=4, h=3, sx1=0.1), "sx1 is 0.1"),
        (framed(latlong=1), r"frames\[1\].latlong is 1"),
        (framed(fl_x=-1), r"frames\[1\].fl_x is -1"),
        (framed(k1=1e300), "k1"),
        (capture(fl_x=float("nan")), "^fl_x is NaN; allowed: a finite number"),
    ],
)
def test_what_is_no_capture_is_refused(fields: Any, message: str) -> None:
    with pytest.raises((InvalidFile, InvalidScene), match=message):
        read(fields)


def test_masks_of_frames_are_said_not_to_be_read() -> None:
    frames = [{"file_path": f"r_{i}", "transform_matrix": EYE, "mask_path": f"masks/r_{i}.png"} for i in range(3)]
    del frames[1]["mask_path"]
    said = "the masks of 2 frames (mask_path) are not read; fit takes masks with `masks=DIR`"
    assert read(capture(w=4, h=3, frames=frames)).notes == (said,)
    assert read(capture(w=4, h=3, mask_path=None)).notes == ()


def test_what_is_no_json_is_refused() -> None:
    for data in (b"{", b"\xff", b"[" * 100_000, b"/*" * 100_000, b'{"frames": [1e999]}', b'{"w": ' + b"9" * 400 + b"}"):
        with pytest.raises(InvalidFile, match="cannot be parsed"):
            cameras_json.decode(memoryview(data))


def test_a_pose_with_nan_names_its_frame_and_element() -> None:
    pose = np.eye(4)
    pose[1, 2] = np.nan
    frames = [{"transform_matrix": each.tolist()} for each in (np.eye(4), pose)]
    data = json.dumps({"camera_angle_x": 1.0, "frames": frames}).encode()  # Python writes NaN
    with pytest.raises(InvalidFile, match=r"^frames\[1\]\.transform_matrix\[1, 2\] is NaN; allowed: a finite number$"):
        cameras_json.decode(memoryview(data))
