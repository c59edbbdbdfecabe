"""Sharp frames of a video as photographs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from PIL import Image

from nerfbake.errors import InvalidFile, OutputError, UsageError
from nerfbake.jobs import find_poses, fit_file, take_frames
from tests.support.videos import write_video


def walk(frames: int = 30) -> list[npt.NDArray[np.floating]]:
    """A wall that passes by; of three frames, two are blurred by the motion, more or less."""
    wall = np.random.default_rng(1).random((48, 72 + 2 * frames, 3)) * 0.8 + 0.1
    blur = [1, 3, 5]  # pixels; the second of three is the sharp one
    width = [blur[(i + 2) % 3] for i in range(frames)]
    return [np.mean([wall[:, 2 * i + k : 2 * i + k + 64] for k in range(width[i])], axis=0) for i in range(frames)]


def test_the_sharp_frames_are_taken(tmp_path: Path) -> None:
    video = write_video(tmp_path / "walk.mp4", walk())
    taken = take_frames(video, tmp_path / "walk", count=10)
    assert taken == (str(tmp_path / "walk"), 10, 30, 29 / 25, 64, 48)
    for number in range(10):
        pixels = np.asarray(Image.open(tmp_path / f"walk/{number:04d}.jpg"), int)
        error = [np.abs(pixels - 255 * each).mean() for each in walk()]
        assert int(np.argmin(error)) == 3 * number + 1
        assert min(error) < 8


def test_the_number_follows_the_length(tmp_path: Path) -> None:
    for frames, rate, expected in ((30, 25, 30), (60, 25, 40), (100, 2, 99), (160, 1, 150)):
        video = write_video(tmp_path / f"{frames}.mkv", [np.zeros((16, 16, 3))] * frames, rate=rate)
        assert take_frames(video, tmp_path / str(frames)).frames == expected


def test_the_same_video_gives_the_same_bytes(tmp_path: Path) -> None:
    video = write_video(tmp_path / "walk.mp4", walk(6))
    for name in "ab":
        take_frames(video, tmp_path / name, count=3)
    assert [(tmp_path / "a" / f"{i:04d}.jpg").read_bytes() for i in range(3)] == [
        (tmp_path / "b" / f"{i:04d}.jpg").read_bytes() for i in range(3)
    ]


def test_only_frames_are_replaced(tmp_path: Path) -> None:
    video = write_video(tmp_path / "walk.mp4", walk(6))
    take_frames(video, tmp_path / "out", count=5)
    with pytest.raises(OutputError, match="exists already"):
        take_frames(video, tmp_path / "out", count=2)
    take_frames(video, tmp_path / "out", count=2, force=True)
    assert len(list((tmp_path / "out").iterdir())) == 2
    (tmp_path / "out/transforms.json").write_text("{}")
    with pytest.raises(OutputError, match=r"has 'transforms\.json', which nerfbake did not write"):
        take_frames(video, tmp_path / "out", count=2, force=True)


def test_a_bad_video_leaves_nothing(tmp_path: Path) -> None:
    data = write_video(tmp_path / "walk.mp4", walk(6)).read_bytes()
    (tmp_path / "cut.mp4").write_bytes(data[: len(data) // 2])
    with pytest.raises(InvalidFile, match="the video cannot be decoded") as caught:
        take_frames(tmp_path / "cut.mp4", tmp_path / "out")
    assert caught.value.source == str(tmp_path / "cut.mp4")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["cut.mp4", "walk.mp4"]


def test_arguments_are_checked_first(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="`count` is 0; allowed: 1 or more"):
        take_frames(tmp_path / "a.mp4", tmp_path / "a", count=0)
    with pytest.raises(UsageError, match="a pipe is neither a video nor a folder"):
        take_frames("-", tmp_path / "a")
    with pytest.raises(InvalidFile, match="No such file"):
        take_frames(tmp_path / "a.mp4", tmp_path / "a")


def test_other_commands_name_this_one(tmp_path: Path) -> None:
    video = write_video(tmp_path / "walk.mp4", walk(2))
    with pytest.raises(InvalidFile, match="is a video; allowed: a folder of its frames, which `nerfbake frames` makes"):
        fit_file(video, tmp_path / "a.npz")
    for source in (video, tmp_path):
        with pytest.raises(InvalidFile, match="allowed: a folder of the video's frames, which `nerfbake frames` makes"):
            find_poses(source)
