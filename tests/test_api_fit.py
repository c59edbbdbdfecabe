"""nerfbake.fit(): the command's own scene, from Python."""

from __future__ import annotations

import inspect
from pathlib import Path

import pytest
from numpy.testing import assert_array_equal

import nerfbake
from nerfbake import jobs
from nerfbake.cli.fit import fit as command
from nerfbake.errors import UsageError

FAST = "cells=32,epochs=1"


@pytest.fixture(scope="module")
def photographs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("capture") / "photographs"
    jobs.write_sample_capture(folder, frames=10, edge=32)
    return folder


def test_the_scene_is_the_commands(photographs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    tree = nerfbake.fit(photographs, epochs=FAST, basis="SH1", seed=3)
    assert capsys.readouterr() == ("", "")
    jobs.fit_file(photographs, tmp_path / "a.npz", options=jobs.FitOptions(epochs=FAST, basis="SH1", seed=3))
    written = nerfbake.load(tmp_path / "a.npz", nerfbake.N3Tree)
    assert_array_equal(tree.data, written.data)
    assert_array_equal(tree.child, written.child)


def test_progress_says_what_is_done(photographs: Path, capsys: pytest.CaptureFixture[str]) -> None:
    nerfbake.fit(photographs, epochs=FAST, basis="SH1", progress=True)
    assert "10 cameras" in capsys.readouterr().err


def test_arguments_are_the_commands_options() -> None:
    options = {option.name for option in command.params}
    given = set(inspect.signature(nerfbake.fit).parameters)
    assert given <= options
    files = {"target", "to", "force", "state", "plot", "as_json", "quiet", "verbose"}
    assert options - given <= files | {"profile", "voxel_type", "max_memory"}


def test_wrong_arguments_are_told_before_any_work() -> None:
    with pytest.raises(UsageError, match="`preset` and `minutes` each select a schedule"):
        nerfbake.fit("nowhere", preset="fast", minutes=1.0)
