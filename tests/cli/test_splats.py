"""`nerfbake splats`: what it writes, prints and refuses."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from nerfbake import Splats, build_octree, build_vdb, jobs, load, sample_n3tree, save
from nerfbake.cli.main import run
from tests.cli.telling import told
from tests.support.outputs import read_output

SMALL = "--count 300 --frames 4 --edge 32 --epochs 2"


@pytest.fixture(autouse=True)
def scenes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    save("a.npz", sample_n3tree(resolution=16, basis="SH4"))


def test_everything_is_told_to_scripts(capsys: pytest.CaptureFixture[str]) -> None:
    facts = told(f"splats a.npz a.ply {SMALL}".split(), capsys)
    assert (facts["in"], facts["file"], facts["bytes"]) == ("a.npz", "a.ply", Path("a.ply").stat().st_size)
    assert facts["splats"] == load("a.ply", Splats).n <= 300
    assert len(facts["views"]) == 8
    assert facts["psnr"] == pytest.approx(sum(view["psnr"] for view in facts["views"]) / 8)
    assert facts["seconds"] > 0


def test_the_last_line_is_the_quality_of_the_file(capsys: pytest.CaptureFixture[str]) -> None:
    jobs.write_sample_capture("photographs", frames=10, edge=32)
    assert (
        run(["splats", "a.npz", "a.spz", "--count", "300", "--views", "photographs", "--epochs", "1", "--force"]) == 0
    )
    last = capsys.readouterr().err.strip().splitlines()[-1]
    assert last.startswith("a.spz: ")
    assert " dB, SSIM " in last
    assert load("a.spz", Splats).antialiased


def test_photographs_of_another_scene_are_refused_before_the_work(capsys: pytest.CaptureFixture[str]) -> None:
    jobs.write_sample_capture("elsewhere", frames=10, edge=32)
    path = Path("elsewhere/transforms.json")
    fields = json.loads(path.read_text())
    for frame in fields["frames"]:
        frame["transform_matrix"][0][3] += 100.0
    path.write_text(json.dumps(fields))
    assert run(["splats", "a.npz", "a.ply", "--views", "elsewhere"]) == 1
    said = "dB on the photographs of elsewhere, where pictures of a single colour have"
    assert said in capsys.readouterr().err.splitlines()[-1]
    assert not Path("a.ply").exists()


def test_below_the_limit_the_output_is_rejected(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(f"splats a.npz a.ply {SMALL} --min-psnr 60 --json".split()) == 3
    said = capsys.readouterr()
    assert read_output("splats", said.out)["psnr"] < 60
    assert "dB on 8 pictures with alpha; allowed: --min-psnr 60" in said.err
    assert Path("a.ply.rejected").exists()
    assert not Path("a.ply").exists()


@pytest.mark.parametrize("ending", ["npz", "svo.npz", "vdb"])
def test_a_scene_without_a_density_is_named(ending: str, capsys: pytest.CaptureFixture[str]) -> None:
    tree = sample_n3tree(resolution=8)
    empty = replace(tree, data=np.zeros_like(tree.data))
    octree = build_octree(empty)
    save(f"empty.{ending}", {"npz": empty, "svo.npz": octree, "vdb": build_vdb(octree)}[ending])
    assert run(f"splats empty.{ending} a.ply {SMALL}".split()) == 1
    said = f"error: empty.{ending}: the field has no leaf with a density; allowed: at least one"
    assert said in capsys.readouterr().err


def test_the_same_seed_gives_the_same_bytes() -> None:
    for name in ("a.ply", "b.ply"):
        assert run(f"splats a.npz {name} {SMALL} --seed 3 -q".split()) == 0
    assert Path("a.ply").read_bytes() == Path("b.ply").read_bytes()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("splats a.npz a.ply --count 0", "'0' is not a number of splats; allowed: 1 to 20M, for example 150k"),
        ("splats a.npz a.ply --count 1e9", "'1e9' is not a number of splats"),
        ("splats a.npz a.ply --views c --frames 8", "--frames has no effect with --views"),
        ("splats a.npz a.ply --masks m", "--masks has no effect without --views; allowed: it with --views"),
        ("splats a.npz -", "splats measures the file that it wrote; allowed: an OUT other than '-'"),
        ("splats a.npz a.npz", "a.npz"),
    ],
)
def test_a_wrong_use_is_one_line(words: str, message: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(words.split()) == 2
    assert message in capsys.readouterr().err
    assert not Path("a.ply").exists()


def test_a_fit_writes_splats(capsys: pytest.CaptureFixture[str]) -> None:
    jobs.write_sample_capture("photographs", frames=10, edge=32)
    assert run(["fit", "photographs", "fitted.ply", "--epochs", "cells=32,epochs=1", "--basis", "SH1"]) == 0
    assert "fitted.ply: " in capsys.readouterr().err.splitlines()[-1]
    assert load("fitted.ply", Splats).n > 100
