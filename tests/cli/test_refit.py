"""`nerfbake refit`: what it takes, what it prints, and what it refuses."""

from __future__ import annotations

from pathlib import Path

import pytest

from nerfbake import build_octree, sample_n3tree, save
from nerfbake.cli.main import run
from tests.cli.telling import told


@pytest.fixture(autouse=True)
def scenes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    tree = sample_n3tree(resolution=16, basis="SH1")
    save("fine.npz", tree)
    save("coarse.svo.npz", build_octree(tree, resolution=8))


def test_everything_is_told_to_scripts(capsys: pytest.CaptureFixture[str]) -> None:
    words = "refit coarse.svo.npz a.svo.pb --like fine.npz --frames 8 --edge 32 --epochs 1 --samples 1 --seed 2"
    facts = told(words.split(), capsys)
    assert (facts["in"], facts["file"], facts["bytes"]) == (
        "coarse.svo.npz",
        "a.svo.pb",
        Path("a.svo.pb").stat().st_size,
    )
    assert len(facts["views"]) == 8
    assert facts["psnr"] == pytest.approx(sum(view["psnr"] for view in facts["views"]) / 8)
    assert facts["psnr"] > facts["psnr_before"]
    assert facts["cpu_seconds"] > 0


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (
            "--views capture --frames 8",
            "--frames has no effect without --like; allowed: --frames and --edge with --like",
        ),
        ("--like fine.npz --masks m", "--masks has no effect without --views; allowed: it with --views"),
        (
            "--like fine.npz --views capture",
            "--like and --views: both are given; allowed: one of them, which IN is fitted to",
        ),
        ("--like fine.npz --epochs 0", "0 is not in the range"),
    ],
)
def test_a_wrong_use_is_one_line(words: str, message: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["refit", "coarse.svo.npz", "a.svo.npz", *words.split()]) == 2
    assert message in capsys.readouterr().err
    assert not Path("a.svo.npz").exists()
