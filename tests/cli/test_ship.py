"""`nerfbake ship`: what it writes, prints and refuses."""

from __future__ import annotations

import json
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest

from nerfbake import sample_n3tree, save
from nerfbake.cli.main import run
from nerfbake.errors import InvalidScene
from nerfbake.jobs.shipping_list import TARGETS
from tests.cli.telling import told


@pytest.fixture(autouse=True)
def scenes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    import_module("nerfbake.jobs.shipments")  # whose defaults are made of it
    monkeypatch.setattr("nerfbake.jobs.budgets.EDGE", 32)
    save("a.npz", sample_n3tree(resolution=8, basis="SH4"))


def test_the_folder_is_told_and_json_is_report_json(capsys: pytest.CaptureFixture[str]) -> None:
    facts = told(["ship", "a.npz", "out", "--for", "unity"], capsys)
    assert facts == json.loads(Path("out/report.json").read_text())
    assert run(["ship", "a.npz", "out", "--for", "unity"]) == 4
    assert "out: exists already; allowed: a new or empty folder, or --force" in capsys.readouterr().err
    assert run(["ship", "a.npz", "out", "--for", "unity", "--force"]) == 0
    last = capsys.readouterr().err.strip().splitlines()[-1]
    assert last == "out: 1 file of a.npz for unity, report.html"


def test_a_failed_file_ends_with_1_and_the_receipt_is_there(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail(*arguments: Any, **options: Any) -> None:
        raise InvalidScene("the octree is no good")

    monkeypatch.setattr("nerfbake.jobs.shipments.bake_octree", fail)
    assert run(["ship", "a.npz", "out", "--for", "unity", "--json"]) == 1
    said = capsys.readouterr()
    assert json.loads(said.out)["files"][0]["reason"] == "the octree is no good"
    assert "error: out: 1 of 1 files failed: scene.svo.pb; allowed: report.html has the reasons" in said.err
    assert {path.name for path in Path("out").iterdir()} == {"report.html", "report.json"}


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("--for blendr", "'blendr' is no target, perhaps 'blender' is meant; allowed: blender, web, ios, unity"),
        ("--for ,", "there is no target; allowed: blender"),
        ("", "Missing option '--for'"),
        ("--for web --frames 3 --views c", "--frames has no effect with --views"),
        ("--for unity --resolution 64", "--resolution has no effect on a PlenOctree; allowed: with a trained field"),
    ],
)
def test_a_wrong_use_is_one_line(words: str, message: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["ship", "a.npz", "out", *words.split()]) == 2
    assert message in capsys.readouterr().err
    assert not Path("out").exists()


def test_the_help_names_every_target(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["ship", "--help"]) == 0
    assert ", ".join(TARGETS) in " ".join(capsys.readouterr().out.split())
