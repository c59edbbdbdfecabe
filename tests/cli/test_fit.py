"""`nerfbake fit`: what it takes, what it prints, and what it refuses."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from nerfbake import N3Tree, load
from nerfbake.cli.main import run
from tests.cli.telling import told
from tests.jobs.fake_fit import FakeFit, fake_fit
from tests.support.photographs import write_scene


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_scene(tmp_path_factory.mktemp("capture") / "scene")


@pytest.fixture
def trainer(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> FakeFit:
    monkeypatch.chdir(tmp_path)
    return fake_fit(monkeypatch)


@pytest.mark.usefixtures("trainer")
def test_everything_is_told_to_scripts(capture: Path, capsys: pytest.CaptureFixture[str]) -> None:
    facts = told(["fit", str(capture), "a.npz", "--plot", "curve.svg"], capsys)
    assert (facts["source"], facts["file"], facts["bytes"]) == (str(capture), "a.npz", Path("a.npz").stat().st_size)
    assert [view["name"] for view in facts["views"]] == ["0000", "0001", "0002", "0003"]
    assert facts["psnr"] == pytest.approx(sum(view["psnr"] for view in facts["views"]) / 4)
    assert {"seconds", "psnr", "stage", "epoch", "resolution", "cells"} == set(facts["curve"][0])
    assert "the written file" in Path("curve.svg").read_text()
    again = told(["fit", str(capture), "b.npz", "--epochs", facts["epochs"]], capsys)
    assert again["epochs"] == facts["epochs"]
    assert Path("a.npz").read_bytes() == Path("b.npz").read_bytes()


def test_options_reach_the_trainer(trainer: FakeFit, capture: Path) -> None:
    options = "--basis SH4 --samples 1 --seed 3 --box -1,-2,-3,1,2,3 --background 10,20,30 --holdout 4 --to svo.pb -q"
    assert run(["fit", str(capture), "a", *options.split()]) == 0
    (asked,) = trainer.asked
    assert (asked["basis"], asked["schedule"][-1].rays, asked["seed"]) == ("SH4", 1, 3)
    assert asked["box"].tolist() == [[-1, -2, -3], [1, 2, 3]]
    assert asked["views"].background == (10 / 255, 20 / 255, 30 / 255)
    assert len(asked["views"].pictures) == 12


def test_the_words_of_a_run(trainer: FakeFit, capture: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["fit", str(capture), "a.npz"]) == 0
    views, schedule, second, third = capsys.readouterr().err.splitlines()
    assert views == f"{capture}: fits to 16 pictures with alpha, measures on 4 pictures with alpha"
    assert schedule.startswith(f"{capture}: --epochs ")
    assert second == f"a.npz: {load('a.npz', N3Tree)}, {Path('a.npz').stat().st_size:,} bytes"
    assert third.startswith("a.npz: ")
    assert " dB, SSIM " in third
    assert run(["fit", str(capture), "a.npz", "--force", "-q"]) == 0
    assert capsys.readouterr().err == ""
    assert len(trainer.asked) == 2


REFUSED: list[tuple[str, int, str]] = [
    ("fit none -", 2, "fit measures the file that it wrote; allowed: an OUT other than '-'"),
    ("fit none a.png", 2, "'a.png' is not the extension of a field or a mesh; allowed: .svo.npz, "),
    ("fit none a.png", 2, ".glb, .ply, .usdz, .spz, .sog, .npz, .obj, or --to FORMAT"),
    ("fit none a.npz --preset fast --minutes 1", 2, "--preset and --minutes each select a schedule; allowed: one"),
    ("fit none a.npz --epochs x --resolution 256", 2, "--resolution has no effect with --epochs"),
    ("fit none a.npz --epochs x", 2, "stage 1 has 'x'; allowed: cells, "),
    ("fit none a.npz --epochs cells=7", 2, "stage 1, cells is 7; allowed: a power of two"),
    ("fit none a.npz --test t.json --holdout 3", 2, "--test and --holdout both select the held-out views; allowed"),
    ("fit none a.npz --background transparent", 2, "'transparent' is not a colour; allowed: auto, white, black, or"),
    ("fit none a.npz --box 0,0,0,1,1", 2, "'0,0,0,1,1' is not a box; allowed: x0,y0,z0,x1,y1,z1 with x0 < x1, "),
    ("fit none a.npz --box 0,0,0,1,1,nan", 2, "is not a box"),
    ("fit none a.npz --box 0,0,0,1,1,0", 2, "is not a box"),
    ("fit none a.npz --plot curve.txt", 2, "is not that of a chart; allowed: .png, .svg"),
    ("fit none a.npz", 1, "none: No such file or directory"),
    ("fit . a.npz", 1, ".: is a folder of unknown kind; allowed: a file, or a folder with transforms.json"),
]  # fmt: skip


@pytest.mark.usefixtures("trainer")
@pytest.mark.parametrize(("line", "code", "named"), REFUSED)
def test_what_is_refused_is_one_line(line: str, code: int, named: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(line.split()) == code
    (said,) = capsys.readouterr().err.splitlines()
    assert said.startswith("error: ")
    assert named in said
    assert not list(Path().iterdir())


def test_memory_is_one_allowance(trainer: FakeFit, capture: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["fit", str(capture), "a.npz", "--max-memory", "30kB"]) == 1
    (said,) = capsys.readouterr().err.splitlines()
    assert "(--max-memory)" in said
    assert trainer.asked == []


def test_facts_are_plain_json(capture: Path, trainer: FakeFit, capsys: pytest.CaptureFixture[str]) -> None:
    facts: Any = told(["fit", str(capture), "a.svo.npz", "--state", "state"], capsys)
    assert json.loads(json.dumps(facts)) == facts
    assert Path("state").is_dir()
    assert len(trainer.asked) == 1
