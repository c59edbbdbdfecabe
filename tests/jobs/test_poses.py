"""Poses of photographs: where they are written, how exact they are, and what is refused."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from PIL import Image as Pillow

from benchmarks.captures import position_errors
from nerfbake import Cameras, NerfbakeError, io, load
from nerfbake.errors import InvalidFile
from nerfbake.installation import command_for
from nerfbake.jobs import PosesResult, Source, WorldOptions, _pycolmap, find_poses, poses
from nerfbake.jobs.poses import require_poses
from nerfbake.jobs.steps import SILENT
from nerfbake.scene.world import World
from tests.conftest import REPOSITORY
from tests.jobs.listener import Listener
from tests.support.fake_pycolmap import CRASHES_ONCE, SLEEPS, replace_pycolmap, write_pycolmap
from tests.support.heic import heic_of
from tests.support.reprojection import reprojection_errors
from tests.support.rooms import FOCAL, HEIGHT, WIDTH, write_room

Array = npt.NDArray[np.float64]
FRAMES = 8
MODEL_FILES = ["cameras.bin", "images.bin", "points3D.bin"]


class Found:
    """Two folders with the same pictures, one of them in `images`, and what find_poses() has found and said."""

    def __init__(self, folder: Path) -> None:
        self.places = folder / "flat", folder / "below"
        self.positions = write_room(self.places[0], frames=FRAMES)
        shutil.copytree(self.places[0], self.places[1] / "images")
        self.listener = Listener()
        self.results = [find_poses(place, steps=self.listener) for place in self.places]


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> Found:
    return Found(tmp_path_factory.mktemp("rooms"))


@pytest.fixture
def photographs(tmp_path: Path) -> Path:
    """Pictures of noise, which have nothing in common."""
    random = np.random.default_rng(0)
    for i in range(4):
        Pillow.fromarray(random.integers(0, 256, (48, 64, 3), np.uint8)).save(tmp_path / f"{i}.png")
    return tmp_path


def positions_of(cameras: Cameras) -> Array:
    return np.array([camera.pose[:3, 3] for camera in cameras.cameras])


def written(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def refused(folder: Path | str, **options: Any) -> str:
    """The error of a call that must leave the folder as it was."""
    before = written(Path(folder))
    with pytest.raises(NerfbakeError) as caught:
        find_poses(folder, **options)
    assert written(Path(folder)) == before
    assert not list(Path(folder).rglob(".*.part"))
    line = f"{caught.value.exit_code} {caught.value}"
    assert "\n" not in line
    return line


@pytest.mark.slow
def test_the_cameras_are_where_they_were(found: Found) -> None:
    cameras = load(found.places[0], Cameras)
    assert [camera.picture for camera in cameras.cameras] == [f"{i:04d}.png" for i in range(FRAMES)]
    assert position_errors(positions_of(cameras), found.positions).max() < 0.01
    (first, *_) = cameras.cameras
    assert (first.width, first.height) == (WIDTH, HEIGHT)
    assert first.fx == pytest.approx(FOCAL, rel=0.02)


@pytest.mark.slow
def test_the_points_are_read_with_the_cameras(found: Found) -> None:
    """Wherever the photographs are: `fit` needs the points."""
    for place in found.places:
        points = load(place, Cameras).points
        assert points is not None
        assert len(points) == found.results[0].points


@pytest.mark.slow
def test_the_model_moves_with_the_cameras(found: Found, tmp_path: Path) -> None:
    """Both outputs are in metres, and the points are still where the pictures show them."""
    shutil.copytree(found.places[0], tmp_path / "room")
    model = tmp_path / "room" / poses.MODEL
    before = load(found.places[0], Cameras)
    world = WorldOptions(scale="0000,0004=12m")
    pictures = [camera.picture for camera in before.cameras]
    *_, known = poses._same_sizes(SILENT, tmp_path / "room", pictures, False)
    moved = poses._placed(SILENT, "room", tmp_path / "room", tmp_path / "room", model, world, known)
    assert sorted(path.name for path in model.iterdir()) == MODEL_FILES
    eyes = positions_of(moved)
    assert np.linalg.norm(eyes[0] - eyes[4]) == pytest.approx(12)
    assert moved.world == World(metres=True)
    again = load(model, Cameras)
    for cameras in (before, again):
        assert reprojection_errors(cameras).mean() < 1.0


@pytest.mark.slow
def test_the_facts_are_those_of_the_model(found: Found) -> None:
    result = found.results[0]
    assert result == PosesResult(str(found.places[0]), FRAMES, FRAMES, result.points, result.error)
    assert result.points > 300
    assert 0 < result.error < 1
    said = f"8 of 8 pictures have a pose; {result.points:,} points, mean reprojection error {result.error:.2f} pixels"
    assert found.listener.said[0] == f"{found.places[0]}: {said}"
    assert found.listener.phases[:4] == [
        "reading 8 pictures",
        "finding features in 8 pictures",
        "matching 28 pairs of pictures",
        "placing 8 cameras",
    ]
    assert found.listener.shares[-1] == (1.0, "")


@pytest.mark.slow
def test_the_same_pictures_and_seed_give_the_same_model(found: Found) -> None:
    flat, below = map(written, found.places)
    names = {name for name in flat if not name.endswith(".png")}
    assert names == {"transforms.json", *(f"sparse/0/{name}" for name in MODEL_FILES)}
    for name in names - {"transforms.json"}:
        assert flat[name] == below[name], name


@pytest.mark.slow
def test_both_files_have_the_same_cameras_and_lead_to_the_pictures(found: Found) -> None:
    for place in found.places:
        ours, colmap = load(place / "transforms.json", Cameras), load(place / "sparse/0", Cameras)
        for camera, other in zip(ours.cameras, colmap.cameras, strict=True):
            assert (camera.focal, camera.centre, camera.lens) == (other.focal, other.centre, other.lens)
            assert camera.pose.tolist() == other.pose.tolist()
            picture = io.find_photograph(place, camera.picture)
            assert picture is not None
            assert picture.name == Path(other.picture).name
    assert {camera.picture for camera in ours.cameras} == {camera.picture for camera in colmap.cameras}


@pytest.mark.slow
def test_pictures_of_two_sizes_have_two_cameras_and_frames_of_a_video_their_order(found: Found, tmp_path: Path) -> None:
    for i, path in enumerate(sorted(found.places[0].glob("*.png"))):
        picture = Pillow.open(path)
        picture.crop((0, 8 * (i % 2), WIDTH, HEIGHT)).save(tmp_path / path.name)
    listener = Listener()
    assert find_poses(tmp_path, sequential=True, steps=listener).registered == FRAMES
    assert [camera.height for camera in load(tmp_path, Cameras).cameras] == [HEIGHT, HEIGHT - 8] * (FRAMES // 2)
    assert "matching 28 pairs of pictures" in listener.phases


@pytest.mark.long
def test_two_rooms_are_two_models_and_the_larger_one_is_kept(tmp_path: Path) -> None:
    write_room(tmp_path, frames=4)
    write_room(tmp_path, frames=6, first=10)
    listener = Listener()
    assert find_poses(tmp_path, steps=listener)[1:3] == (10, 6)
    warning, _ = listener.said
    assert "the pictures form 2 models" in warning
    assert "the largest has 6 of 10 pictures" in warning
    assert all(camera.name.startswith("001") for camera in load(tmp_path, Cameras).cameras)


@pytest.mark.long
def test_many_pictures_give_the_same_bytes_on_any_number_of_threads(
    found: Found, monkeypatch: pytest.MonkeyPatch
) -> None:
    code = "from nerfbake.jobs import _pycolmap as m; m.FEW = m.OPENCV_FROM = 6; m.main()"  # 8 are many
    monkeypatch.setattr(poses, "_COMMAND", [sys.executable, "-c", code])
    outputs = []
    for threads, place in zip(("1", "3"), found.places, strict=True):
        folder = place.with_name(f"many-{place.name}")
        shutil.copytree(place, folder, ignore=shutil.ignore_patterns("sparse", "*.json"))
        monkeypatch.setenv("NUMBA_NUM_THREADS", threads)
        listener = Listener()
        assert find_poses(folder, steps=listener).registered == FRAMES
        assert listener.phases[2:4] == ["comparing 28 pairs of pictures", "matching 28 pairs of pictures"]
        outputs.append([(folder / "sparse" / "0" / name).read_bytes() for name in MODEL_FILES])
    assert outputs[0] == outputs[1]
    cameras = load(folder, Cameras)
    assert position_errors(positions_of(cameras), found.positions).max() < 0.01
    lens = cameras.cameras[0].lens
    assert lens is not None
    assert all(lens.p)  # not only k1 is fitted


@pytest.mark.slow
def test_a_picture_without_features_is_left_out_and_one_may_have_a_long_name_or_be_heic(tmp_path: Path) -> None:
    write_room(tmp_path, frames=5)
    for name, new in (("0003.png", "0003.HEIC"), ("0004.png", "0004.png")):  # one has the extension of another format
        with Pillow.open(tmp_path / name) as picture:
            heic = heic_of(picture)
        (tmp_path / name).unlink()
        (tmp_path / new).write_bytes(heic)
    long = f"the third of them {'影' * 77}.png"  # 253 bytes
    (tmp_path / "0002.png").rename(tmp_path / long)
    Pillow.new("RGB", (WIDTH, HEIGHT), (128, 128, 128)).save(tmp_path / "grey.png")
    assert find_poses(tmp_path)[1:3] == (6, 5)
    names = [camera.picture for camera in load(tmp_path, Cameras).cameras]
    assert names == ["0000.png", "0001.png", "0003.HEIC", "0004.png", long]
    assert (tmp_path / "0004.png").read_bytes() == heic
    assert sorted(path.name for path in (tmp_path / "sparse" / "0").iterdir()) == MODEL_FILES


def test_without_pycolmap_its_extra_is_named(photographs: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    said = f"2 finding poses needs pycolmap, which is not installed; allowed: {command_for('pycolmap')}"
    assert refused(photographs) == said


def test_a_pycolmap_that_cannot_be_imported_is_told(photographs: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    replace_pycolmap(photographs, "raise ImportError('libgomp is missing')", monkeypatch)
    said = f"pycolmap cannot be imported (libgomp is missing); allowed: {command_for('pycolmap')}"
    assert refused(photographs) == f"2 {photographs}: {said}"


@pytest.mark.parametrize(
    ("code", "said"),
    [
        (
            "import os, sys\nprint('double free', file=sys.stderr, flush=True)\nos.abort()",
            "crashed twice, the second time with signal 6: double free",
        ),
        ("import os\nos._exit(3)", "crashed twice, the second time with exit code 3"),
        ("class logging: pass\ndef set_random_seed(seed): raise RuntimeError('no disk')", "failed: no disk"),
    ],
)
def test_a_crash_of_pycolmap_is_an_error_of_one_line(
    code: str, said: str, photographs: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    replace_pycolmap(photographs, code, monkeypatch)
    assert refused(photographs).startswith(f"1 {photographs}: pycolmap {said}")


FAILS = (
    "class logging: pass\ndef set_random_seed(seed): raise RuntimeError('No registered database factory succeeded.')"
)


@pytest.mark.parametrize(
    "code",
    [
        "class logging: pass\ndef set_random_seed(seed): raise RuntimeError('database or disk is full')",
        "import os, sys\nprint('what(): database or disk is full', file=sys.stderr, flush=True)\nos.abort()",
    ],
)
def test_a_full_disk_is_no_bad_input(code: str, photographs: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    replace_pycolmap(photographs, code, monkeypatch)
    assert refused(photographs) == f"4 {photographs}: No space left on device"


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs Linux")
def test_a_full_disk_is_found_where_pycolmap_does_not_tell_it(
    photographs: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened = tempfile.TemporaryFile

    def full(*, dir: Path | None = None) -> Any:
        return opened() if dir is None else Path("/dev/full").open("wb")

    replace_pycolmap(photographs, FAILS, monkeypatch)
    assert refused(photographs).startswith(f"1 {photographs}: pycolmap failed: No registered database factory")
    monkeypatch.setattr(tempfile, "TemporaryFile", full)
    monkeypatch.setattr(poses, "_require_outputs", lambda folder, force: None)
    assert refused(photographs) == f"4 {photographs}: No space left on device"


def test_a_folder_that_is_removed_meanwhile_is_named(photographs: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    code = f"import pathlib, shutil\nshutil.rmtree(pathlib.Path(__file__).with_name('sparse'))\n{FAILS}"
    replace_pycolmap(photographs, code, monkeypatch)
    found = "was removed while pycolmap was using it; allowed: a folder that stays"
    assert refused(photographs) == f"4 {photographs}/sparse: {found}"


@pytest.mark.parametrize("name", ["sparse", "sparse/0", "transforms.json"])
@pytest.mark.parametrize("there", [True, False])
def test_outputs_are_not_written_through_a_link(
    name: str, there: bool, photographs: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    outside = tmp_path_factory.mktemp("outside") / "a"
    if there:
        outside.mkdir()
    (photographs / name).parent.mkdir(exist_ok=True)
    (photographs / name).symlink_to(outside)
    for force in (False, True):
        said = refused(photographs, force=force)
        assert said == f"4 {photographs / name}: is a symbolic link; allowed: a regular file or folder"
    assert outside.exists() == there
    assert not there or not any(outside.iterdir())


@pytest.mark.parametrize("name", ["transforms.json", "transforms_train.json", "poses_bounds.npy", "sparse"])
def test_a_broken_link_in_place_of_cameras_is_named_and_no_poses_are_found(name: str, photographs: Path) -> None:
    (photographs / name).symlink_to("/nowhere/a")
    with pytest.raises(InvalidFile) as caught:
        require_poses(SILENT, Source(str(photographs)))
    found = "is a symbolic link to /nowhere/a, which does not exist; allowed: a file"
    assert str(caught.value) == f"{photographs / name}: {found}"
    with pytest.raises(InvalidFile, match="is a symbolic link to /nowhere/a"):
        load(photographs)


@pytest.mark.slow
@pytest.mark.skipif(os.name != "posix", reason="signals")
def test_one_crash_of_pycolmap_is_survived(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_room(tmp_path, frames=4)
    replace_pycolmap(tmp_path, CRASHES_ONCE, monkeypatch)
    listener = Listener()
    assert find_poses(tmp_path, steps=listener).registered == 4
    said = "warning: pycolmap crashed with signal 7; it runs once more, with one thread"
    assert listener.said[0] == f"{tmp_path}: {said}"
    assert sorted(path.name for path in (tmp_path / "sparse" / "0").iterdir()) == MODEL_FILES


def test_after_a_crash_pycolmap_has_one_thread_and_a_new_folder(
    photographs: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[Mapping[str, Any]] = []

    def run_once(steps: Any, request: Mapping[str, Any]) -> tuple[dict[str, Any], str]:
        asked.append(request)
        Path(request["work"]).mkdir()
        return ({}, "signal 7") if len(asked) == 1 else ({"models": []}, "")

    monkeypatch.setattr(poses, "_run_once", run_once)
    monkeypatch.setenv("NUMBA_NUM_THREADS", "5")
    assert "too few points" in refused(photographs)
    assert [request["threads"] for request in asked] == [5, 1]
    assert asked[1]["at_once"] is False


def test_a_crash_is_told_without_its_stack_trace(photographs: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    lines = ("what(): the database is malformed", "*** Aborted at 1", "PC: @ 0x7f", "*** SIGABRT", "    @  0x7f main")
    replace_pycolmap(photographs, f"import os, sys\nsys.stderr.write({chr(10).join(lines)!r})\nos.abort()", monkeypatch)
    assert refused(photographs).endswith("the second time with signal 6: what(): the database is malformed")


def test_pycolmap_is_alone_with_numpy_in_its_process(photographs: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # Pillow has corrupted the heap there; a second SQLite releases the locks of pycolmap's, which ends with signal 7.
    code = """
import sys
class logging: pass
def set_random_seed(seed): raise RuntimeError(str({"PIL", "_sqlite3", "numba", "numpy"} & sys.modules.keys()))
"""
    replace_pycolmap(photographs, code, monkeypatch)
    assert refused(photographs) == f"1 {photographs}: pycolmap failed: {{'numpy'}}"


@pytest.mark.slow
def test_the_process_of_pycolmap_ends_without_an_error(tmp_path: Path) -> None:
    write_room(tmp_path, frames=3)
    names = sorted(path.name for path in tmp_path.iterdir())
    request = {"pictures": str(tmp_path), "groups": [names], "panoramas": [], "model": str(tmp_path)}
    line = (
        json.dumps({**request, "work": str(tmp_path / "work"), "sequential": False, "seed": 0, "threads": 2}).encode()
        + b"\n"
    )
    command = [sys.executable, "-m", "nerfbake.jobs._pycolmap"]
    with subprocess.Popen(command, cwd=REPOSITORY, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        process.stdin.write(line)
        process.stdin.flush()  # and stays open
        assert json.loads(process.stdout.readlines()[-1])["models"] == [3]
        assert process.wait(timeout=20) == 0
    assert not (tmp_path / "work").exists()


@pytest.mark.skipif(os.name != "posix", reason="signals")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_the_process_of_pycolmap_ends_with_ours(number: int, photographs: Path) -> None:
    environment = os.environ | write_pycolmap(photographs, SLEEPS)
    command = [sys.executable, "-m", "nerfbake", "poses", str(photographs)]
    with subprocess.Popen(command, env=environment, cwd=REPOSITORY, stderr=subprocess.DEVNULL) as process:
        started = photographs / "started"
        _wait(lambda: started.exists() and started.read_text() != "")
        process.send_signal(number)
        assert process.wait(timeout=20) == (-number if number == signal.SIGKILL else 128 + number)
    _wait(lambda: not _runs(int(started.read_text())))
    assert not (photographs / "transforms.json").exists()
    assert (photographs / "sparse").exists() == (number == signal.SIGKILL)


def _wait(condition: Any) -> None:
    end = time.monotonic() + 20
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.02)


def _runs(process: int) -> bool:
    """Whether a process runs, and is not only waiting for somebody to ask how it ended."""
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def test_pictures_without_common_points_have_no_poses(photographs: Path) -> None:
    said = refused(photographs)
    assert said.startswith(f"1 {photographs}: the pictures have too few points in common to find poses; allowed: sharp")
    assert not (photographs / "sparse").exists()


def test_a_folder_without_enough_pictures_is_refused(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("none")
    (tmp_path / ".hidden.png").write_text("none")
    allowed = "allowed: 3 or more .jpg, .jpeg, .png or .heic in the folder or in its subfolder images"
    assert refused(tmp_path) == f"1 {tmp_path}: the pictures are missing; {allowed}"
    for name in ("a.JPG", "b.HIF"):
        (tmp_path / name).write_bytes(b"")
    assert refused(tmp_path) == f"1 {tmp_path}: the pictures are 2; {allowed}"
    assert refused(tmp_path / "gone") == f"1 {tmp_path}/gone: does not exist; allowed: a folder of photographs"
    with pytest.raises(InvalidFile, match="x: File name too long"):
        find_poses("x" * 300)
    assert refused(tmp_path / "a.JPG") == f"1 {tmp_path}/a.JPG: is not a folder; allowed: a folder of photographs"


def test_pictures_and_videos_that_are_not_read_are_named(tmp_path: Path) -> None:
    (tmp_path / "images").mkdir()
    (tmp_path / "images" / "b.WEBP").write_bytes(b"")
    (tmp_path / "clip.mov").write_bytes(b"")
    said = "the pictures are missing, except for files such as b.WEBP; allowed: 3 or more .jpg, .jpeg, .png or .heic"
    assert refused(tmp_path).startswith(f"1 {tmp_path}: {said}")
    with pytest.raises(InvalidFile, match=said):
        require_poses(SILENT, Source(str(tmp_path)))
    for name in ("a.jxl", "a.ARW"):
        (tmp_path / "images" / "b.WEBP").rename(tmp_path / "images" / name)
        assert f"except for files such as {name}; allowed" in refused(tmp_path)
        (tmp_path / "images" / name).rename(tmp_path / "images" / "b.WEBP")
    (tmp_path / "images" / "b.WEBP").unlink()
    assert "except for files such as clip.mov; allowed" in refused(tmp_path)
    (tmp_path / "clip.mov").unlink()
    with pytest.raises(InvalidFile, match="is a folder of unknown kind"):
        require_poses(SILENT, Source(str(tmp_path)))


def test_a_picture_that_fit_cannot_read_is_refused(photographs: Path) -> None:
    picture = photographs / "2.png"
    picture.write_bytes(picture.read_bytes()[:2000])
    assert refused(photographs).startswith(f"1 {picture}: ")


@pytest.mark.parametrize("name", ["transforms.json", "sparse/0/images.bin"])
def test_existing_poses_are_kept(name: str, photographs: Path) -> None:
    (photographs / name).parent.mkdir(parents=True, exist_ok=True)
    (photographs / name).write_bytes(b"by hand")
    assert "exists already" in refused(photographs)
    assert refused(photographs, force=True).startswith(f"1 {photographs}: the pictures have too few")


def test_a_seed_that_pycolmap_does_not_take_is_refused(photographs: Path) -> None:
    assert refused(photographs, seed=2**31) == "2 `seed` is 2147483648; allowed: 0 to 2147483647"


@pytest.mark.parametrize(("pictures", "sequential"), [(150, False), (151, True)])
def test_many_pictures_are_matched_in_their_order(
    pictures: int, sequential: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[Mapping[str, Any]] = []

    def run(steps: Any, name: str, request: Mapping[str, Any]) -> dict[str, Any]:
        asked.append(request)
        return {"models": []}

    monkeypatch.setattr(poses, "_run", run)
    for i in range(pictures):
        Pillow.new("RGB", (8, 8)).save(tmp_path / f"{i:03d}.jpg")
    refused(tmp_path)
    refused(tmp_path, sequential=not sequential)
    assert [request["sequential"] for request in asked] == [sequential, not sequential]


@pytest.mark.data
@pytest.mark.slow
def test_photographs_that_overlap_little_are_placed_at_once(
    data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every sixth photograph of a walk around a toy; one after another, fewer of them can be placed."""
    capture = data / "captures" / "plush"
    run_once, found = poses._run_once, []
    for at_once in (False, True):
        folder = tmp_path / f"{at_once}"
        folder.mkdir()
        for path in sorted((capture / "images").iterdir())[::6]:
            with Pillow.open(path) as picture:
                picture.resize((504, 378), Pillow.Resampling.LANCZOS).save(folder / path.name, quality=95)
        asked = partial(lambda at_once, steps, request: run_once(steps, {**request, "at_once": at_once}), at_once)
        monkeypatch.setattr(poses, "_run_once", asked)
        found.append(find_poses(folder).registered)
    assert found[1] >= found[0] + 3
    given = {Path(camera.picture).name: camera.pose[:3, 3] for camera in load(capture, Cameras).cameras}
    cameras = load(folder, Cameras)
    known = np.array([given[camera.picture] for camera in cameras.cameras])
    assert position_errors(positions_of(cameras), known).max() < 0.05


def test_a_picture_that_few_points_hold_is_dropped() -> None:
    """Pictures 1, 2 and 3 share points in pairs, 4 shares too few with them, and 5 with 6 alone."""
    dropped: list[int] = []
    groups = [((1, 2), 15), ((2, 3), 15), ((1, 4), 8), ((3, 4), 8), ((5, 6), 40)]
    points = [SimpleNamespace(track=track_of(numbers)) for numbers, count in groups for _ in range(count)]
    model = SimpleNamespace(
        points3D=dict(enumerate(points)),
        images={i: SimpleNamespace(has_pose=i != 7, frame_id=10 * i) for i in range(1, 8)},
        deregister_frame=dropped.append,
    )
    _pycolmap._drop_loose(model)
    assert sorted(dropped) == [40, 50, 60]


def track_of(numbers: tuple[int, ...]) -> SimpleNamespace:
    return SimpleNamespace(elements=[SimpleNamespace(image_id=number) for number in numbers])


@pytest.mark.data
@pytest.mark.long
def test_photographs_of_a_phone_agree_with_a_given_model(data: Path, tmp_path: Path) -> None:
    capture = data / "captures" / "plush"
    names = sorted(path.name for path in (capture / "images").iterdir())[:12]
    (tmp_path / "images").mkdir()
    for name in names:
        with Pillow.open(capture / "images" / name) as picture:
            picture.resize((504, 378), Pillow.Resampling.LANCZOS).save(tmp_path / "images" / name, quality=95)
    result = find_poses(tmp_path)
    assert result.registered == result.pictures == 12
    assert result.error < 1
    given = {Path(camera.picture).name: camera for camera in load(capture, Cameras).cameras}
    cameras = load(tmp_path, Cameras)
    assert [Path(camera.picture).name for camera in cameras.cameras] == names
    known = np.array([given[name].pose[:3, 3] for name in names])
    assert position_errors(positions_of(cameras), known).max() < 0.03
