"""The benchmark of a graphics card, on a software adapter."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path

import pytest

from benchmarks import gpu
from benchmarks.scenes import Scenes
from benchmarks.suite import SUITE, run
from nerfbake import build_field, orbit_cameras, sample_n3tree, save
from nerfbake.errors import UsageError
from tests.support.device import software
from tests.support.photographs import write_scene
from tests.support.splats import ball_of_splats


@pytest.mark.long
@pytest.mark.usefixtures("in_this_process")
def test_small_fits_and_pictures(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    tree, data = sample_n3tree(resolution=16), tmp_path / "data"
    for folder in ("plenoctree/chair", "nerf_synthetic/chair"):
        (data / folder).mkdir(parents=True)
    save(data / "plenoctree/chair/chair_sh9.npz", tree)
    cameras = orbit_cameras(build_field(tree), frames=2, width=8, height=8)
    save(data / "nerf_synthetic/chair/transforms_test.json", cameras)
    (data / "splats").mkdir()
    save(data / "splats/biker.spz", ball_of_splats(50))
    write_scene(data / "capture")
    options = ("--epochs", "cells=8,scale=2", "--basis", "SH1")
    rows = gpu.Row("small", "capture", options), gpu.Row("absent", "nowhere", options)
    monkeypatch.setattr(gpu, "ROWS", rows)
    monkeypatch.setattr(gpu, "DEVICE", software().split(" ")[0])
    monkeypatch.setattr(gpu, "_run", cache(gpu._run))  # the second run is as long as the first one
    monkeypatch.setattr(gpu, "FRAMES", 2)
    monkeypatch.setattr(gpu, "EDGE", 16)
    (benchmark,) = (each for each in SUITE if each.name == "gpu")
    files = run(benchmark, Scenes(data, tmp_path), rounds=1)
    assert tuple(files) == benchmark.files
    fits, pictures = (table["rows"] for table in json.loads(files["gpu.json"])["tables"])
    assert fits[0]["device"] == software()
    assert float(fits[0]["PSNR dB"]) > 15
    assert 0 < fits[0]["alone s"] < fits[0]["s, second run"]
    assert fits[1]["fit"].startswith("absent: ")
    assert [row["device"] for row in pictures] == [software(), "cpu"] * 2


def test_without_a_card_the_error_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gpu, "DEVICE", "no such card")
    with pytest.raises(UsageError, match=r"`device` is 'no such card'"):
        gpu.reports(Scenes(tmp_path, tmp_path))
