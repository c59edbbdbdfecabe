"""bench fit: its figures are those of `nerfbake fit`, and it resumes."""

from __future__ import annotations

import json
import os
import shutil
import signal
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from PIL import Image as Pillow

from nerfbake import N3Tree, build_field, load, measure_views
from nerfbake.bench.fit import comparison
from nerfbake.bench.fit.comparison import FITS, PROTOCOL, chart_papers, compare_papers, find_scenes, inspect_scene
from nerfbake.bench.report import Report, Table
from nerfbake.cli.main import run
from nerfbake.errors import InvalidFile, UsageError
from nerfbake.jobs.files import Source
from nerfbake.jobs.photographs import PhotographOptions, read_photographs
from nerfbake.jobs.steps import SILENT
from tests.support.outputs import read_output
from tests.support.photographs import write_scene

SHORT = "cells=32,epochs=1/cells=32,epochs=1,rays=2"


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two small scenes as NeRF-Synthetic is downloaded: with pictures of depth and normals beside the test views."""
    dataset = tmp_path_factory.mktemp("nerf_synthetic")
    write_scene(dataset / "lego", frames=8)
    for name in ("0000_depth_0000", "0000_normal_0000", "0001_depth_0000"):
        Pillow.new("RGBA", (32, 32), (255, 0, 0, 255)).save(dataset / "lego" / "test" / f"{name}.png")
    shutil.copytree(dataset / "lego", dataset / "chair")
    (dataset / "README.txt").write_text("not a scene")
    (dataset / "__MACOSX").mkdir()
    return dataset


@pytest.fixture
def dataset(made: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(made, tmp_path / "nerf_synthetic"))


@pytest.fixture
def short(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every preset is a schedule of two epochs."""
    monkeypatch.setattr(comparison, "_schedule", lambda preset: ("--epochs", SHORT, "--basis", "SH1"))


# fit SOURCE OUT [...] --state DIR [...]: writes OUT, notes its arguments, and prints figures. A file `fail` or `hang`
# in SOURCE makes it fail, or wait until it is stopped.
STUB = """
import json, os, pathlib, sys, time
arguments = sys.argv[1:]
source, out = arguments[1:3]
state = pathlib.Path(arguments[arguments.index("--state") + 1])
resumed = state.exists()
state.mkdir(parents=True, exist_ok=True)
with open(os.environ["CALLS"], "a") as calls:
    calls.write(json.dumps([pathlib.Path(source).name, *arguments[3:5], resumed]) + "\\n")
if os.path.exists(source + "/fail.png"):
    os.write(int(os.environ["NERFBAKE_RESULT"]), b'{"error": "no such light"}\\n')
    sys.exit(1)
while os.path.exists(source + "/hang.png"):
    time.sleep(0.05)
pathlib.Path(out).write_bytes(b"x" * 2_000_000)
best = "best" in arguments
curve = [{"cells": 7, "stage": 2 if best else 1}]
facts = {"psnr": 30.125 + best, "ssim": 0.95, "cpu_seconds": 240.0, "seconds": 130.0, "bytes": 2_000_000}
print(json.dumps({**facts, "epochs": "a/b", "views": [{}] * 2, "curve": curve}))
"""


@pytest.fixture
def calls(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[], list[list[Any]]]:
    """A stub takes the place of nerfbake. Returns the calls since the last time."""
    (tmp_path / "stub.py").write_text(STUB)
    note = tmp_path / "calls"
    monkeypatch.setenv("CALLS", str(note))
    command = [sys.executable, "-S", "-E", str(tmp_path / "stub.py")]
    monkeypatch.setattr("nerfbake.jobs.batches.nerfbake_command", lambda: command)

    def taken() -> list[list[Any]]:
        text = note.read_text() if note.exists() else ""
        note.unlink(missing_ok=True)
        return [json.loads(line) for line in text.splitlines()]

    return taken


def rows(report: Report | None, number: int = 0) -> list[dict[str, Any]]:
    assert report is not None
    table = report.tables[number]
    return [dict(zip(table.columns, row, strict=True)) for row in table.rows]


@pytest.mark.slow
@pytest.mark.usefixtures("short")
def test_the_figures_are_those_of_the_written_file_on_all_test_views(
    dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    state = tmp_path / "state"
    words = ["bench", "fit", str(dataset), "--scenes", "lego", "--preset", "fast", "--state", str(state)]
    assert run([*words, "--format", "json"]) == 0
    facts = read_output("bench", capsys.readouterr().out)
    (fit,) = facts["tables"][0]["rows"]
    views = read_photographs(
        SILENT, Source(str(dataset / "lego")), PhotographOptions(background=(1.0, 1.0, 1.0))
    ).held_out
    errors = measure_views(build_field(load(state / "lego.fast.npz", N3Tree)), views, samples=2)
    assert [error.name for error in errors] == ["0000", "0001"]
    assert fit["PSNR dB"] == f"{sum(error.psnr for error in errors) / 2:.2f}"
    assert fit["SSIM"] == f"{sum(error.ssim for error in errors) / 2:.4f}"
    assert (fit["scene"], fit["test views"]) == ("lego", 2)
    assert fit["MB"] == (state / "lego.fast.npz").stat().st_size / 1e6
    assert fit["peak MB"] > 50
    assert not (state / "lego.fast.checkpoints").exists()
    beside = {row["method"]: row for row in facts["tables"][1]["rows"]}
    assert (beside["Plenoxels"]["lego"], beside["Plenoxels"]["source"]) == ("34.09", "PlenVDB, table 2")
    assert beside["nerfbake, fast"]["lego"] == fit["PSNR dB"]
    assert beside["nerfbake, fast"]["minutes"] == pytest.approx(fit["s"] / 60)
    told = "lego is not the papers' scene: 8 training views, 2 test views of 32x32 (100 training views, 200 test views"
    assert any(note.startswith(told) for note in facts["notes"])


def test_the_table_of_two_scenes_by_hand(dataset: Path, tmp_path: Path, calls: Callable[[], list[Any]]) -> None:
    report, batch = compare_papers(str(dataset), state=str(tmp_path / "s"), presets=("fast", "best"))
    assert batch.exit_code == 0
    options = [["fast", False], ["best", False]]
    assert calls() == [[scene, "--preset", *option] for option in options for scene in ("chair", "lego")]
    fits = rows(report)
    assert [(row["scene"], row["preset"], row["PSNR dB"]) for row in fits] == [
        ("chair", "fast", "30.12"),
        ("lego", "fast", "30.12"),
        ("chair", "best", "31.12"),
        ("lego", "best", "31.12"),
        ("mean", "fast", "30.12"),
        ("mean", "best", "31.12"),
    ]
    assert [row["s"] for row in fits] == [120.0] * 6
    assert [row["wall s"] for row in fits] == [130.0] * 6
    assert [row["cells"] for row in fits] == [None, None, 7, 7, None, 7]  # the curve of `fast` ends before its fit
    beside = {row["method"]: row for row in rows(report, 1)}
    assert list(beside)[-2:] == ["nerfbake, fast", "nerfbake, best"]
    ours, dvgo, mcmc = beside["nerfbake, best"], beside["DVGO"], beside["3DGS-MCMC"]
    assert [ours[key] for key in ("chair", "lego", "mean", "minutes", "MB")] == ["31.12", "31.12", "31.12", 2.0, 2.0]
    assert ours["hardware"].startswith("two cores of ")
    assert ours["source"] == "this run, other scenes"
    assert (dvgo["mean"], dvgo["MB"]) == ("34.36", 206.0)  # (34.06 + 34.65) / 2
    assert dvgo["minutes"] == pytest.approx((4 + 3 / 60 + 4 + 31 / 60) / 2)
    assert (mcmc["chair"], mcmc["minutes"], mcmc["MB"]) == ("36.32", None, None)
    chart = chart_papers(report, ".svg").decode() if report else ""
    assert all(f">{name}<" in chart for name in ("Plenoxels", "TensoRF", "nerfbake, best", "V100 (PlenVDB, table 2)"))
    assert ">3DGS-MCMC<" not in chart  # without minutes it has no place


def test_what_is_done_is_not_run_again_unless_its_inputs_change(
    dataset: Path, tmp_path: Path, calls: Callable[[], list[Any]]
) -> None:
    def again(**options: Any) -> list[str]:
        report, batch = compare_papers(str(dataset), state=str(tmp_path / "s"), **options)
        assert (report is not None, batch.exit_code) == (True, 0)
        return [call[0] for call in calls()]

    assert again() == ["chair", "lego"]
    assert again() == []
    assert again(scenes=("lego",)) == []
    assert again(presets=("fast",)) == ["chair", "lego"]
    Pillow.new("RGBA", (32, 32), (0, 0, 255, 255)).save(dataset / "lego" / "train" / "0003.png")
    assert again() == ["lego"]
    (tmp_path / "s" / "chair.best.npz").unlink()
    assert again() == ["chair"]
    with (dataset / "lego" / "transforms_test.json").open("a") as cameras:
        cameras.write("\n")
    assert again() == ["lego"]


def test_the_memory_limit_is_that_of_each_fit(
    dataset: Path, tmp_path: Path, calls: Callable[[], list[Any]], capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["bench", "fit", str(dataset / "lego"), "--state", str(tmp_path / "s"), "--max-memory", "1GB"]
    assert run(words) == 0
    capsys.readouterr()
    plan = (tmp_path / "s" / "plan.txt").read_text()
    assert "--preset best --max-memory 1000000000 --background white" in plan
    assert calls() == [["lego", "--preset", "best", False]]


def test_a_fit_that_fails_leaves_its_error_and_its_checkpoints(
    dataset: Path, tmp_path: Path, calls: Callable[[], list[Any]], capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["bench", "fit", str(dataset), "--state", str(tmp_path / "s")]
    (dataset / "lego" / "fail.png").write_bytes(b"")
    assert run(words) == 1
    text = capsys.readouterr().out
    assert "| lego: no such light | best | - | - |" in text
    assert "| mean | best | - | - |" in text
    assert "| nerfbake, best | 31.12 | - | - | - | - |" in text
    (dataset / "lego" / "fail.png").unlink()
    calls()
    assert run(words) == 0
    assert calls() == [["lego", "--preset", "best", True]]  # from its checkpoint
    assert list((tmp_path / "s").glob("*.checkpoints")) == []


@pytest.mark.usefixtures("calls")
def test_ctrl_c_ends_with_130_and_says_how_to_go_on(
    dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (dataset / "lego" / "hang.png").write_bytes(b"")
    words, state = ["bench", "fit", str(dataset)], str(tmp_path / "s")

    def interrupt() -> None:
        while not (tmp_path / "calls").exists() or "lego" not in (tmp_path / "calls").read_text():
            time.sleep(0.01)
        (tmp_path / "calls").unlink()
        os.kill(os.getpid(), signal.SIGINT)

    for options, told in (
        (["--state", state], f"run the same command to resume from {state}"),
        ([], "nothing is kept"),
    ):
        other = threading.Thread(target=interrupt)
        other.start()
        assert run([*words, *options]) == 130
        other.join()
        output = capsys.readouterr()
        assert output.out == ""
        assert output.err.splitlines()[-1].startswith("2 items: 1 done, 1 killed; stopped by SIGINT; ")
        assert told in output.err.splitlines()[-1]


@pytest.mark.usefixtures("calls")
def test_a_changed_log_is_refused_in_one_line(dataset: Path, tmp_path: Path) -> None:
    def fitted() -> None:
        compare_papers(str(dataset), scenes=("lego",), state=str(tmp_path / "s"))

    fitted()
    (log,) = (tmp_path / "s" / "log").iterdir()
    for content, told in ((b"{}", "has no bytes"), (b"[", "cannot be parsed"), (b"[]", "holds a list")):
        log.write_bytes(content)
        with pytest.raises(InvalidFile, match=rf"^{log}: the output of the fit {told}"):
            fitted()
    log.unlink()
    with pytest.raises(InvalidFile, match=rf"^{log}: No such file"):
        fitted()


def test_scenes_come_in_the_order_of_the_papers(made: Path, tmp_path: Path) -> None:
    assert list(find_scenes(str(made))) == ["chair", "lego"]
    assert list(find_scenes(str(made), ("lego", "chair"))) == ["chair", "lego"]
    assert find_scenes(str(made / "lego")) == {"lego": made / "lego"}
    mine = tmp_path / "mine"
    for name in ("ship", "a_cup", "chair"):
        shutil.copytree(made / "lego", mine / name)
    assert list(find_scenes(str(mine))) == ["chair", "ship", "a_cup"]


def test_what_differs_from_the_protocol_is_found(made: Path, tmp_path: Path) -> None:
    assert str(inspect_scene(made / "lego")) == "8 training views, 2 test views of 32x32"
    scene = Path(shutil.copytree(made / "lego", tmp_path / "opaque"))
    (scene / "train" / "0000.png").unlink()
    for picture in scene.glob("test/*.png"):
        Pillow.new("RGB", (48, 48)).save(picture)
    assert str(inspect_scene(scene)) == "7 training views, 2 test views of 48x48 without alpha"
    assert str(PROTOCOL) == "100 training views, 200 test views of 800x800"


@pytest.mark.data
def test_the_real_chair_is_the_scene_of_the_papers(data: Path) -> None:
    assert inspect_scene(data / "nerf_synthetic_800" / "chair") == PROTOCOL


def test_what_cannot_be_fitted_is_refused_before_anything_runs(
    dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], calls: Callable[[], list[Any]]
) -> None:
    def refused(*words: str) -> str:
        assert run(["bench", "fit", *words]) in (1, 2)
        return capsys.readouterr().err.strip()

    root = str(dataset)
    assert refused(str(tmp_path / "gone")) == f"error: {tmp_path}/gone: No such file or directory"
    (tmp_path / "empty").mkdir()
    needed = "has no scenes; allowed: folders with transforms_train.json and transforms_test.json"
    assert refused(str(tmp_path / "empty")) == f"error: {tmp_path}/empty: {needed}"
    assert refused(root, "--scenes", "lgo,chair") == (
        f"error: {root} has no scene 'lgo', perhaps lego; allowed: chair, lego"
    )
    assert refused(root, "--scenes", "xyz") == f"error: {root} has no scene 'xyz'; allowed: chair, lego"
    assert refused(root, "--preset", "quick").startswith("error: Invalid value for '--preset': 'quick' is not known;")
    assert refused(root, "--table", "own", "--plot", "a.svg").startswith("error: --plot shows published figures; ")
    for picture in (dataset / "lego" / "test").glob("000?.png"):
        picture.unlink()
    assert refused(root).startswith(f"error: {root}/lego/transforms_test.json: picture test/0000 is not there;")
    (dataset / "lego" / "transforms_test.json").unlink()
    assert refused(root) == f"error: {root}/lego: has no transforms_test.json; allowed: a scene with its test views"
    assert calls() == []


def test_a_chart_needs_the_published_figures() -> None:
    with pytest.raises(UsageError, match="the chart shows published figures; allowed: `table=published`"):
        chart_papers(Report("", {}, [Table("Fits", FITS, [])], []), ".svg")
