"""Photographs of the sample scene, fitted by the real command in a process of its own, which may be killed."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
from PIL import Image as Pillow

from nerfbake import N3Tree, SparseVoxelOctree, Volume, load
from tests.conftest import DATA
from tests.support.photographs import write_scene

OPTIONS = ("--resolution", "32", "--basis", "SH4", "--preset", "fast", "--json")


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where `capture` stands, and what an undisturbed run has made of it: whole.npz and figures.json."""
    folder = tmp_path_factory.mktemp("fit")
    write_scene(folder / "capture", frames=24, edge=40)
    done = fit(folder, "whole.npz")
    assert done.returncode == 0, done.stderr
    (folder / "figures.json").write_text(done.stdout)
    return folder


def command(*arguments: str) -> list[str]:
    return [sys.executable, "-m", "nerfbake", "fit", "capture", *arguments, *OPTIONS]


def fit(folder: Path, *arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
    variables = os.environ | environment
    return subprocess.run(
        command(*arguments), cwd=folder, env=variables, capture_output=True, text=True, timeout=600, check=False
    )


@pytest.mark.slow
def test_views_that_were_kept_come_back(place: Path) -> None:
    figures = json.loads((place / "figures.json").read_text())
    assert figures["psnr"] > 23.5  # 24.57 dB
    assert figures["ssim"] > 0.9
    assert len(figures["views"]) == 6
    curve = [point["psnr"] for point in figures["curve"]]
    assert curve[-1] > curve[0]


@pytest.mark.long
@pytest.mark.slow
@pytest.mark.parametrize(("name", "kind"), [("a.svo.pb", SparseVoxelOctree), ("a.nvdb", Volume), ("a.vdb.npz", Volume)])
def test_every_format_renders_alike(name: str, kind: type, place: Path) -> None:
    figures = json.loads((place / "figures.json").read_text())
    done = fit(place, name)
    assert done.returncode == 0, done.stderr
    assert isinstance(load(place / name), kind)
    assert json.loads(done.stdout)["psnr"] == pytest.approx(figures["psnr"], abs=0.05)


@pytest.mark.slow
def test_the_bytes_are_the_same_on_one_thread(place: Path) -> None:
    done = fit(place, "one.npz", NUMBA_NUM_THREADS="1")
    assert done.returncode == 0, done.stderr
    assert (place / "one.npz").read_bytes() == (place / "whole.npz").read_bytes()


def until(condition: Any, process: subprocess.Popen[str]) -> None:
    deadline = time.monotonic() + 300
    while not condition():
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < deadline
        time.sleep(0.01)


@pytest.mark.long
@pytest.mark.slow
def test_a_run_that_is_killed_goes_on_to_the_same_bytes(place: Path) -> None:
    checkpoint = place / "killed" / "checkpoint.npz"
    seen = list[bytes]()
    for _ in range(2):
        process = subprocess.Popen(
            command("killed.npz", "--state", "killed"),
            cwd=place,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        until(lambda: checkpoint.exists() and [checkpoint.read_bytes()] != seen[-1:], process)
        process.kill()
        process.communicate()
        seen.append(checkpoint.read_bytes())
    done = fit(place, "killed.npz", "--state", "killed")
    assert done.returncode == 0, done.stderr
    assert (place / "killed.npz").read_bytes() == (place / "whole.npz").read_bytes()


@pytest.mark.slow
def test_ctrl_c_leaves_what_there_is_and_says_so(place: Path) -> None:
    arguments = command("stopped.npz", "--state", "stopped")
    process = subprocess.Popen(arguments, cwd=place, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    until((place / "stopped" / "checkpoint.npz").exists, process)
    process.send_signal(signal.SIGINT)
    _, said = process.communicate(timeout=300)
    assert process.returncode == 130
    (line,) = [line for line in said.splitlines() if line.startswith("error")]
    what = "stopped.npz.partial has the current state; run the same command to resume from stopped"
    assert line == f"error: stopped before the end: {what}"
    assert not (place / "stopped.npz").exists()
    (place / "stopped.npz.partial").rename(place / "partial.npz")
    assert load(place / "partial.npz", N3Tree).problems() == []


def quartered(source: Path, target: Path) -> Path:
    """A capture with every picture at a quarter of its size: a sixteenth of the rays."""
    for path in source.rglob("*.png"):
        small = target / path.relative_to(source)
        small.parent.mkdir(parents=True, exist_ok=True)
        with Pillow.open(path) as image:
            image.convert("RGBa").reduce(4).convert("RGBA").save(small)
    for path in source.glob("transforms*.json"):
        shutil.copy(path, target)
    return target


@pytest.mark.data
@pytest.mark.long
def test_the_real_chair(tmp_path: Path) -> None:
    """Measured with the pictures that nobody trained on. `benchmarks/fit.py` measures them at their full size."""
    capture = quartered(DATA / "nerf_synthetic" / "chair", tmp_path / "chair")
    options = ("--preset", "fast", "--resolution", "64", "--json")
    arguments = [sys.executable, "-m", "nerfbake", "fit", str(capture), "chair.npz", *options]
    done = subprocess.run(arguments, cwd=tmp_path, capture_output=True, text=True, timeout=1200, check=False)
    assert done.returncode == 0, done.stderr
    figures = json.loads(done.stdout)
    assert len(figures["views"]) == 25
    assert figures["psnr"] > 34  # 35.55 dB
