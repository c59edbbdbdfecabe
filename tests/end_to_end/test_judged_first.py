"""`--min-psnr`: a file gets its name after it was judged, whatever happens in between."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from nerfbake import sample_n3tree, sample_stage1, save
from nerfbake.io import save_folder
from tests.conftest import Shell

pytestmark = pytest.mark.long

HALT = """
import os, signal, sys
from nerfbake.cli import main
from nerfbake.jobs import lattices, pages  # they keep their own compare_scenes()
from nerfbake.stages import scenes_to_comparison
number = getattr(signal, sys.argv.pop(1))
scenes_to_comparison.compare_scenes = lambda *arguments, **options: os.kill(os.getpid(), number)
main.main()
"""
COMMANDS = {
    "svo": ("svo", "a.npz", "out", "--to", "svo.pb"),
    "vdb": ("vdb", "a.npz", "out", "--to", "vdb"),
    "compress": ("compress", "a.npz", "out", "--to", "svoq", "--step", "0.5"),
    "view": ("view", "a.npz", "out", "--to", "html", "--data", "exact"),
    "atlas": ("atlas", "stage1", "out", "--clusters", "2", "--map-size", "8"),
}
FOLDERS = ("atlas",)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    save("a.npz", sample_n3tree(resolution=8))
    save_folder("stage1", sample_stage1(resolution=16))
    return tmp_path


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir() if path.name not in ("a.npz", "stage1"))


def halted(command: str, number: signal.Signals, *more: str) -> int:
    """The exit code of a command that gets a signal when it begins to judge."""
    line = [sys.executable, "-c", HALT, number.name, *COMMANDS[command], "--min-psnr", "10", *more]
    return subprocess.run(line, capture_output=True, timeout=120, check=False).returncode


@pytest.mark.slow
@pytest.mark.parametrize("command", COMMANDS)
def test_a_kill_while_judging_leaves_no_file_of_that_name(folder: Path, command: str, shell: Shell) -> None:
    assert halted(command, signal.SIGKILL) == -signal.SIGKILL
    (left,) = names(folder)
    assert left.startswith(".out.")
    assert left.endswith(".part")
    done = shell(*COMMANDS[command], "--min-psnr", "0")
    assert done.returncode == 0, done.stderr
    assert names(folder) == ["out"]  # and what the dead one left is gone


@pytest.mark.slow
def test_ctrl_c_while_judging_leaves_what_stood_there(folder: Path) -> None:
    Path("out").write_bytes(b"good")
    assert halted("svo", signal.SIGINT, "--force") == 130
    assert names(folder) == ["out"]
    assert Path("out").read_bytes() == b"good"


@pytest.mark.slow
@pytest.mark.parametrize("command", COMMANDS)
def test_a_rejected_result_leaves_what_it_would_have_replaced(folder: Path, command: str, shell: Shell) -> None:
    good = Path("out") / "atlas.json" if command in FOLDERS else Path("out")
    good.parent.mkdir(exist_ok=True)
    good.write_bytes(b"good")
    assert shell(*COMMANDS[command], "--min-psnr", "300", "--force").returncode == 3
    assert names(folder) == ["out", "out.rejected"]
    assert good.read_bytes() == b"good"
    # The rejected result of the time before is replaced, too: --force says so.
    assert shell(*COMMANDS[command], "--min-psnr", "300", "--force").returncode == 3
    assert names(folder) == ["out", "out.rejected"]


@pytest.mark.parametrize("command", COMMANDS)
def test_somebody_elses_rejected_is_not_touched_without_force(folder: Path, command: str, shell: Shell) -> None:
    mine = Path("out.rejected") / "mine.txt" if command in FOLDERS else Path("out.rejected")
    mine.parent.mkdir(exist_ok=True)
    mine.write_bytes(b"mine")
    done = shell(*COMMANDS[command], "--min-psnr", "300")
    assert done.returncode == 4
    told = b", and has 'mine.txt', which nerfbake did not write" if command in FOLDERS else b""
    assert done.stderr.startswith(b"error: out.rejected: exists already" + told + b"; allowed: a new ")
    assert done.stderr.count(b"\n") == 1
    assert mine.read_bytes() == b"mine"
    assert names(folder) == ["out.rejected"]


def test_a_folder_in_the_place_of_the_rejected_file_is_never_removed(folder: Path, shell: Shell) -> None:
    Path("out.rejected").mkdir()
    done = shell(*COMMANDS["svo"], "--min-psnr", "300", "--force")
    assert done.returncode == 4
    assert b"out.rejected: is a folder; allowed: a file" in done.stderr
    assert names(folder) == ["out.rejected"]


@pytest.mark.slow
@pytest.mark.parametrize("command", ["compress", "atlas"])
@pytest.mark.parametrize(("least", "left"), [("0", "out"), ("300", "out.rejected")])
def test_a_reader_that_closes_the_pipe_does_not_lose_the_result(
    folder: Path, command: str, least: str, left: str
) -> None:
    line = [sys.executable, "-m", "nerfbake", *COMMANDS[command], "--min-psnr", least, "--json"]
    reading, writing = os.pipe()
    os.close(reading)
    done = subprocess.run(line, stdout=writing, stderr=subprocess.PIPE, timeout=120, check=False)
    os.close(writing)
    assert done.returncode == 141
    assert names(folder) == [left]
