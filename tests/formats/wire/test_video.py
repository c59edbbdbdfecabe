"""Frames of videos: their colours, their orientation, and files that are none."""

from __future__ import annotations

import io
import sys
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from nerfbake.errors import InvalidFile, MemoryLimit, UsageError
from nerfbake.formats.wire.video import container_of, opened_video
from nerfbake.memory import memory_limit
from tests.support.videos import BT601, BT709, BT2020, HLG, PQ, write_sound, write_video

PATCHES = np.array([[200, 30, 30], [30, 200, 30], [30, 30, 200], [128, 128, 128], [250, 240, 20], [5, 9, 30]]) / 255
# x, y of red, green, blue and white: ITU-R BT.709-6 and BT.2020-2.
_XY = {
    BT709: ((0.64, 0.33), (0.30, 0.60), (0.15, 0.06), (0.3127, 0.3290)),
    BT2020: ((0.708, 0.292), (0.170, 0.797), (0.131, 0.046), (0.3127, 0.3290)),
}


def picture(patches: npt.NDArray[np.floating] = PATCHES) -> npt.NDArray[np.floating]:
    """Two rows of patches, 32x32 pixels each."""
    return np.kron(patches.reshape(2, -1, 3), np.ones((32, 32, 1)))


def first_frame(path: Path) -> npt.NDArray[np.uint8]:
    with path.open("rb") as file, opened_video(file) as video:
        return next(iter(video)).pixels()


def to_xyz(space: int) -> npt.NDArray[np.floating]:
    """The matrix of a space's primaries, by its definition: white is the sum of the three."""
    *primaries, white = ((x / y, 1, (1 - x - y) / y) for x, y in _XY[space])
    columns = np.array(primaries).T
    return np.asarray(columns * np.linalg.solve(columns, white))


def linear_of(srgb: npt.NDArray[np.floating]) -> npt.NDArray[np.floating]:
    return np.asarray(np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4))


@pytest.mark.parametrize("matrix", [BT601, BT709])
@pytest.mark.parametrize("full", [False, True])
@pytest.mark.parametrize("ending", [".mp4", ".mov", ".mkv"])
def test_colours_are_those_that_were_stored(tmp_path: Path, matrix: int, full: bool, ending: str) -> None:
    path = write_video(tmp_path / f"a{ending}", [picture()] * 2, matrix=matrix, full=full)
    assert np.abs(first_frame(path) - 255 * picture()).max() <= 1.5


def hlg_of(light: npt.NDArray[np.floating]) -> npt.NDArray[np.floating]:
    """BT.2100-2, table 5, for light whose reference white is the 75 % signal."""
    scene = light * (np.exp((0.75 - 0.55991073) / 0.17883277) + 0.28466892) / 12
    upper = 0.17883277 * np.log(np.maximum(12 * scene - 0.28466892, 1e-9)) + 0.55991073
    return np.asarray(np.where(scene <= 1 / 12, np.sqrt(3 * scene), upper))


def pq_of(light: npt.NDArray[np.floating]) -> npt.NDArray[np.floating]:
    """BT.2100-2, table 4, for light whose reference white is 203 cd/m2, the 58 % signal."""
    power = (light * 203 / 10000) ** 0.1593017578125
    return np.asarray(((0.8359375 + 18.8515625 * power) / (1 + 18.6875 * power)) ** 78.84375)


@pytest.mark.parametrize(("curve", "encoded"), [(HLG, hlg_of), (PQ, pq_of)])
def test_hdr_of_a_phone_becomes_srgb(tmp_path: Path, curve: int, encoded: object) -> None:
    assert callable(encoded)
    wide = linear_of(picture()) @ np.linalg.solve(to_xyz(BT2020), to_xyz(BT709)).T
    path = write_video(tmp_path / "a.mkv", [encoded(wide)], matrix=BT2020, curve=curve)
    assert np.abs(first_frame(path) - 255 * picture()).max() <= 3


def test_light_beyond_reference_white_is_white(tmp_path: Path) -> None:
    bright = hlg_of(np.full((16, 16, 3), 2.5))
    assert first_frame(write_video(tmp_path / "a.mkv", [bright], matrix=BT2020, curve=HLG)).min() >= 254


@pytest.mark.parametrize("turned", [0, 1, 2, 3])
def test_frames_are_upright(tmp_path: Path, turned: int) -> None:
    path = write_video(tmp_path / "a.mp4", [picture()], turned=turned)
    upright = np.rot90(picture(), turned)
    pixels = first_frame(path)
    assert pixels.shape == upright.shape
    assert np.abs(pixels - 255 * upright).max() <= 1.5


def test_facts_are_those_of_the_frames(tmp_path: Path) -> None:
    path = write_video(tmp_path / "a.mp4", [picture()] * 26)
    with path.open("rb") as file, opened_video(file) as video:
        assert (video.size, video.frames, video.seconds) == ((96, 64), 26, 1.0)
        frames = list(video)
    assert len(frames) == 26
    assert frames[0].grey(48).shape == (32, 48)
    assert frames[0].grey(500).shape == (64, 96)


def test_pictures_are_no_videos() -> None:
    assert container_of(b"\0\0\0\x20ftypheic") == ""
    assert container_of(b"\0\0\0\x20ftypqt  ") == "mov"
    assert container_of(b"RIFF\0\0\0\0AVI ") == "avi"
    assert container_of(b"RIFF\0\0\0\0WEBP") == ""


def test_containers_that_name_other_files_are_refused() -> None:
    playlist = b"#EXTM3U\n#EXTINF:1,\nother.mp4\n#EXT-X-ENDLIST\n"
    with (
        pytest.raises(InvalidFile, match=r"is no video that is read; allowed: \.mp4, "),
        opened_video(io.BytesIO(playlist)),
    ):
        pass


def test_sound_alone_is_refused(tmp_path: Path) -> None:
    data = write_sound(tmp_path / "a.mp4").read_bytes()
    with pytest.raises(InvalidFile, match=r"the video has no pictures"), opened_video(io.BytesIO(data)):
        pass


def test_a_cut_video_is_refused(tmp_path: Path) -> None:
    data = write_video(tmp_path / "a.mp4", [picture()] * 5).read_bytes()
    for cut in (40, len(data) // 2):
        with (
            pytest.raises(InvalidFile, match=r"the video (cannot be decoded|has 0 frames)"),
            opened_video(io.BytesIO(data[:cut])) as video,
        ):
            assert len([frame.pixels() for frame in video]) == 5


def test_large_frames_count_against_the_limit(tmp_path: Path) -> None:
    data = write_video(tmp_path / "a.mkv", [np.zeros((1024, 1024, 3))]).read_bytes()
    with memory_limit(1 << 24), pytest.raises(MemoryLimit), opened_video(io.BytesIO(data)):
        pass


def test_a_missing_library_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    data = write_video(tmp_path / "a.mp4", [picture()]).read_bytes()
    monkeypatch.setattr("nerfbake.installation.find_spec", lambda name: None)
    monkeypatch.setitem(sys.modules, "av", None)
    said = r"reading a video needs av, which is not installed; allowed: .*video"
    with pytest.raises(UsageError, match=said), opened_video(io.BytesIO(data)):
        pass
