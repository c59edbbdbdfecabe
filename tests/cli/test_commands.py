"""The commands as a shell sees them: data on stdout, words on stderr, exit codes that make understands."""

from __future__ import annotations

import io
import json
import os
import pty
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import nerfbake
from nerfbake import load, save
from nerfbake.cli.main import run
from nerfbake.cli.params import Size
from nerfbake.scene.octree import SparseVoxelOctree
from tests.conftest import Shell
from tests.support.scenes import assert_same_octree, n3tree


@pytest.fixture
def tree_file(tmp_path: Path) -> Path:
    save(tmp_path / "a.npz", n3tree(splits=[(0, (1, 0, 1))], data_format="SH4"))
    return tmp_path / "a.npz"


@pytest.mark.usefixtures("tree_file")
def test_a_pipeline(shell: Shell, tmp_path: Path) -> None:
    first = shell("svo", "a.npz", "-", "--to", "svo.pb", "--layout", "compact")
    assert (first.returncode, first.stderr.count(b"\n")) == (0, 1)
    second = shell("convert", "-", "-", "--to", "svo.npz", "-q", stdin=first.stdout)
    assert (second.returncode, second.stderr) == (0, b"")
    third = shell("lod", "-", "b.svo.pb", "--level", "1", stdin=second.stdout)
    assert third.returncode == 0
    assert third.stdout == b""
    octree = load(tmp_path / "b.svo.pb", SparseVoxelOctree)
    assert (octree.size, octree.layout, octree.level_sizes) == ((2, 2, 2), "compact", [1, 8])
    told = json.loads(shell("info", "-", "--json", stdin=second.stdout).stdout)
    assert (told["format"], told["nodes_per_level"]) == ("svo.npz", [1, 8, 8])
    with np.load(io.BytesIO(second.stdout)) as npz:
        assert npz["size"].tolist() == [4, 4, 4]


@pytest.mark.usefixtures("tree_file")
def test_options_of_svo(shell: Shell, tmp_path: Path) -> None:
    options = [
        "--resolution",
        "5x4X3",
        "--resample",
        "nearest",
        "--dtype",
        "float16",
        "--no-child=-1",
        "--sigma-min",
        "0",
    ]
    assert shell("svo", "a.npz", "b.svo.npz", *options).returncode == 0
    with np.load(tmp_path / "b.svo.npz") as npz:
        assert npz["size"].tolist() == [5, 4, 3]
        assert npz["node_data"].dtype == np.float16
        assert npz["node_children"].min() == -1
    expected = nerfbake.build_octree(
        load(tmp_path / "a.npz"), resolution=(5, 4, 3), resample="nearest", dtype="float16", sigma_min=0
    )
    assert_same_octree(load(tmp_path / "b.svo.npz", SparseVoxelOctree), expected)


@pytest.mark.usefixtures("tree_file")
@pytest.mark.parametrize(
    ("arguments", "code", "said"),
    [
        (["svo", "nope.npz", "b.svo.pb"], 1, "nope.npz: No such file or directory"),
        (["svo", ".", "b.svo.pb"], 1, ".: is a folder that nerfbake does not know"),
        (["svo", "a.npz", "nowhere/b.svo.pb"], 4, "nowhere/b.svo.pb: No such file or directory"),
        (["svo", "a.npz", "a.npz"], 2, "'a.npz' has no ending that an octree is written with; allowed: .svo.npz"),
        (["svo", "a.npz", "-"], 2, "stdout has no ending that names a format; allowed: --to FORMAT"),
        (["svo", "a.npz", "b.svo.pb", "--to", "obj"], 2, "an octree is not written as 'obj'"),
        (["svo", "a.npz"], 2, "Missing argument 'OUT'"),
        (["svo", "a.npz", "b.svo.pb", "--resolutoin", "4"], 2, "No such option"),
        (["svo", "a.npz", "b.svo.pb", "--resolution", "4x4"], 2, "'4x4' is no resolution; allowed: R or WxHxD"),
        (["svo", "a.npz", "b.svo.pb", "--resolution", "4097"], 2, "'4097' is no resolution"),
        (["svo", "a.npz", "b.svo.pb", "--sigma-min", "nan"], 1, "a.npz: sigma_min is nan; allowed: 0 or more"),
        (["svo", "a.npz", "b.svo.pb", "--max-memory", "many"], 2, "'many' is no size; allowed: 4GiB"),
        (["svo", "a.npz", "b.svo.pb", "--max-memory", "100"], 1, "B; allowed: 100 B (--max-memory)"),
        (
            ["convert", "a.npz", "b.svo.pb"],
            1,
            "makes an octree of it); allowed: an octree or a volume",
        ),
        (["sample", "octree", "c.npz", "--resolution", "100"], 1, "resolution is 100; allowed: a power of two"),
        (["nonsense"], 2, "No such command 'nonsense'"),
    ],
)
def test_what_goes_wrong_is_one_line(shell: Shell, tmp_path: Path, arguments: list[str], code: int, said: str) -> None:
    before = sorted(tmp_path.iterdir())
    done = shell(*arguments)
    (line,) = done.stderr.decode().splitlines()
    assert line.startswith("error: ")
    assert said in line
    assert (done.returncode, done.stdout) == (code, b"")
    assert sorted(tmp_path.iterdir()) == before


@pytest.mark.usefixtures("tree_file")
def test_an_existing_output_is_found_before_the_work(shell: Shell, tmp_path: Path) -> None:
    (tmp_path / "b.svo.pb").write_bytes(b"old")
    done = shell("svo", "a.npz", "b.svo.pb", "-v")
    assert (done.returncode, done.stderr) == (4, b"error: b.svo.pb: exists already; allowed: a new file, or --force\n")
    assert (tmp_path / "b.svo.pb").read_bytes() == b"old"
    assert shell("svo", "a.npz", "b.svo.pb", "--force").returncode == 0


@pytest.mark.usefixtures("tree_file")
def test_quiet_and_verbose(shell: Shell) -> None:
    assert shell("svo", "a.npz", "b.svo.pb", "-q").stderr == b""
    words = shell("svo", "a.npz", "c.svo.pb", "-v").stderr.decode().splitlines()
    assert [line.split(":")[0] for line in words] == [
        "reading a.npz",
        "building the octree",
        "writing c.svo.pb",
        "c.svo.pb",
    ]


def test_check_lists_everything_and_exits_1(shell: Shell, tmp_path: Path) -> None:
    tree = n3tree()
    tree.data[0, 0, 0, 0, 1] = np.nan
    tree.data[0, 1, 0, 0, 3] = -1
    save(tmp_path / "bad.npz", tree)
    done = shell("check", "bad.npz")
    assert done.returncode == 1
    assert done.stdout.decode().splitlines() == [
        "bad.npz: data[0, 0, 0, 0, 1] is nan; allowed: a finite number",
        "bad.npz: data[0, 1, 0, 0, 3] is -1; allowed: a density of 0 or more (--sigma-min 0 reads less as empty)",
    ]
    told = json.loads(shell("check", "bad.npz", "--json").stdout)
    assert not told["ok"]
    assert told["problems"][0]["place"] == "data[0, 0, 0, 0, 1]"
    (tmp_path / "cut.npz").write_bytes((tmp_path / "bad.npz").read_bytes()[:-100])
    cut = "cut.npz: file is no whole zip archive (File is not a zip file); allowed: an .npz as NumPy writes it"
    assert shell("check", "cut.npz").stdout.decode().splitlines() == [cut]
    assert shell("check", "nope.npz").stdout.decode().count("allowed") == 1
    save(tmp_path / "good.npz", n3tree())
    done = shell("check", "good.npz", "--json")
    assert (done.returncode, json.loads(done.stdout)) == (0, {"file": "good.npz", "ok": True, "problems": []})
    # What check finds fault with, a cut reads as empty.
    tree.data[0, 0, 0, 0, 1] = 0
    save(tmp_path / "negative.npz", tree)
    assert shell("svo", "negative.npz", "a.svo.pb").returncode == 1
    assert shell("svo", "negative.npz", "a.svo.pb", "--sigma-min", "0").returncode == 0


def test_a_reader_that_closes_the_pipe_is_no_error(shell: Shell, tmp_path: Path) -> None:
    shell("sample", "octree", "a.npz", "--resolution", "32")
    command = f"{sys.executable} -m nerfbake svo a.npz - --to svo.pb -q | head -c 10 > head; echo ${{PIPESTATUS[0]}}"
    done = subprocess.run(["bash", "-c", command], cwd=tmp_path, capture_output=True, text=True, check=True)
    assert (done.stdout, done.stderr) == ("141\n", "")


@pytest.mark.usefixtures("tree_file")
def test_bytes_are_not_poured_over_a_terminal(tmp_path: Path) -> None:
    leader, follower = pty.openpty()
    command = [sys.executable, "-m", "nerfbake", "svo", "a.npz", "-", "--to", "svo.pb"]
    done = subprocess.run(command, cwd=tmp_path, stdout=follower, stderr=subprocess.PIPE, check=False)
    os.close(follower)
    os.close(leader)
    assert (done.returncode, done.stderr) == (2, b"error: stdout is a terminal; allowed: a pipe or a file\n")


def test_a_terminal_sees_that_something_is_going_on(tmp_path: Path) -> None:
    code = """if True:
        import time
        from nerfbake.cli.words import Words
        with Words(quiet=False, verbose=False).phase("thinking hard"):
            time.sleep(1.6)"""
    leader, follower = pty.openpty()
    subprocess.run([sys.executable, "-c", code], stderr=follower, check=True)
    os.close(follower)
    assert b"thinking hard" in os.read(leader, 1 << 16)
    os.close(leader)
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, check=True).stderr == b""


def test_help_of_every_command_shows_a_line_to_paste(capsys: pytest.CaptureFixture[str]) -> None:
    for command in ("svo", "convert", "lod", "info", "check", "sample octree"):
        assert run([*command.split(), "--help"]) == 0
        assert f"  nerfbake {command} " in capsys.readouterr().out


@pytest.mark.parametrize(("text", "size"), [("100", 100), ("1.5KiB", 1536), ("2 MB", 2_000_000), ("4gib", 4 << 30)])
def test_sizes(text: str, size: int) -> None:
    assert Size().convert(text, None, None) == size
