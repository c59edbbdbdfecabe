"""`nerfbake poses`: what it prints, what it passes on, and its exit codes."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import pytest

from nerfbake.cli.main import run
from nerfbake.installation import command_for
from nerfbake.jobs import PosesResult, WorldOptions, poses
from tests.cli.telling import told
from tests.support.rooms import write_room


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> list[dict[str, Any]]:
    """The options with which the job is called, in place of its work."""
    calls: list[dict[str, Any]] = []

    def find_poses(source: str, *, steps: object, **options: Any) -> PosesResult:
        calls.append({"source": source, **options})
        return PosesResult(source, 12, 11, 922, 0.5)

    monkeypatch.setattr(poses, "find_poses", find_poses)
    return calls


def test_options_reach_the_job(asked: list[dict[str, Any]]) -> None:
    plain = {"source": "photographs", "panoramas": False}
    assert run(["poses", "photographs"]) == 0
    assert run(["poses", "photographs", "--sequential", "--seed", "3", "--force", "--ground"]) == 0
    assert asked == [
        plain | {"sequential": None, "seed": 0, "world": WorldOptions(), "force": False},
        plain | {"sequential": True, "seed": 3, "world": WorldOptions(ground=True), "force": True},
    ]


@pytest.mark.usefixtures("asked")
def test_facts_for_scripts(capsys: pytest.CaptureFixture[str]) -> None:
    facts = told(["poses", "photographs"], capsys)
    expected = {"folder": "photographs", "pictures": 12, "registered": 11, "points": 922, "error": 0.5}
    assert facts == {"version": 1, **expected}


@pytest.mark.slow
def test_poses_are_found_once_and_replaced_on_demand(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_room(tmp_path, frames=6)
    assert told(["poses", str(tmp_path)], capsys)["registered"] == 6
    assert run(["poses", str(tmp_path)]) == 4
    assert capsys.readouterr().err.endswith("exists already; allowed: a new file, or --force\n")
    assert told(["poses", str(tmp_path), "--force"], capsys)["registered"] == 6
    assert run(["info", str(tmp_path)]) == 0


def test_a_folder_without_pictures_is_bad_input(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["poses", str(tmp_path)]) == 1
    assert capsys.readouterr().err.startswith(f"error: {tmp_path}: the pictures are missing; allowed: 3 or more")


def test_a_missing_library_is_wrong_usage(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    for name in ("a.jpg", "b.jpg", "c.jpg"):
        (tmp_path / name).write_bytes(b"")
    assert run(["poses", str(tmp_path)]) == 2
    assert capsys.readouterr().err.endswith(f"is not installed; allowed: {command_for('pycolmap')}\n")


def test_a_seed_that_is_too_large_is_wrong_usage() -> None:
    assert run(["poses", "photographs", "--seed", str(2**31)]) == 2
