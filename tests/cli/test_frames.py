"""`nerfbake frames`: what it prints, and its exit codes."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from nerfbake.cli.main import run
from tests.support.videos import write_video


def test_frames_are_counted(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    video, out = write_video(tmp_path / "a.mp4", [np.zeros((16, 32, 3))] * 26), str(tmp_path / "out")
    assert run(["frames", str(video), out, "--count", "4", "--json"]) == 0
    printed = capsys.readouterr()
    facts = json.loads(printed.out)
    assert facts == {"version": 1, "folder": out, "frames": 4, "of": 26, "seconds": 1.0, "width": 32, "height": 16}
    assert "4 of 26 frames, the sharpest of every 0.25 seconds, 32x16 pixels" in printed.err
    assert run(["frames", str(video), out]) == 4
    assert run(["frames", str(video), out, "--force", "-q"]) == 0
    assert len(list(Path(out).iterdir())) == 26


def test_exit_codes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "a.mp4").write_bytes(b"no video at all")
    assert run(["frames", str(tmp_path / "a.mp4"), str(tmp_path / "out")]) == 1
    assert capsys.readouterr().err == (
        f"error: {tmp_path / 'a.mp4'}: is no video that is read; allowed: .mp4, .mov, .mkv, .webm or .avi\n"
    )
    assert run(["frames", "a.mp4", "out", "--count", "0"]) == 2
    assert not (tmp_path / "out").exists()
