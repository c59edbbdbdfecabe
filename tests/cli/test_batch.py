"""`nerfbake batch`: what is refused before anything runs, what is printed, and what it ends with."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from nerfbake import sample_n3tree, save
from nerfbake.cli.main import run
from tests.batch.conftest import folder as folder
from tests.conftest import REPOSITORY

TEMPLATE = "svo {in} out/{stem}.svo.pb"


def inputs(*names: str, word: str = "fine") -> list[str]:
    for name in names:
        Path(f"in/{name}").write_bytes(f"{word}\n".encode() + os.fsencode(name))
    return [f"in/{name}" for name in names]


def batch(*arguments: str) -> int:
    return run(["batch", *arguments])


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ([], "there is no folder for the state; allowed: --state DIR, or --plan"),
        (["--plan"], "there is no command to run; allowed: TEMPLATE, or --jobs-file"),
        ([TEMPLATE, "--state", "run"], "there are no items to run; allowed: INPUTS, or --allow-empty"),
        ([TEMPLATE, "in/a", "--jobs-file", "j", "--state", "run"], "TEMPLATE and --jobs-file both select the items"),
        (["svo {in} {where}", "in/a", "--state", "run"], "the template has '{where}'; allowed: {in}, "),
        (["svo {in} out", "in/a", "in/b", "--state", "run"], "writes 'out', as item 1 "),
        (["svo {in} {in}", "in/a", "--state", "run"], "writes 'in/a', which item 1 "),
        (["svo {in} run", "in/a", "--state", "run"], "writes 'run', which belongs to the batch"),
        (["svo {in} -", "in/a", "--state", "run"], "reads or writes a stream; allowed in a batch: files and folders"),
        (["svo {in} out --resolution x", "in/a", "--state", "run"], "input 'in/a': Invalid value for '--resolution'"),
        (["svo {in}", "in/a", "--state", "run"], "input 'in/a': Missing argument 'OUT'."),
        (["svo {in} --help", "in/a", "--state", "run"], "only prints its help; allowed: a command with its "),
        (["batch {in}", "in/a", "--state", "run"], "'batch' cannot run in a batch; allowed: atlas, "),
        (["sample {in}", "in/a", "--state", "run"], "'in/a' cannot run in a batch; allowed: capture, "),
        (
            [TEMPLATE, "in/a", "--state", "run", "--shard", "2/2"],
            "'2/2' is not a shard; allowed: i/n, from 0/n to n-1/n",
        ),
        ([TEMPLATE, "in/a", "--state", "run", "--report", "r.pdf"], "the extension of 'r.pdf' is not that of a report"),
        ([TEMPLATE, "in/a", "--plan", "--state", "run"], "--state has no effect with --plan"),
        (["--state", "run", "-j", "2"], "--jobs has no effect without TEMPLATE and --jobs-file"),
        (["--jobs-file", "broken.txt", "--state", "run"], "broken.txt, line 2 has no closing quotation"),
    ],
)
def test_what_is_wrong_is_told_before_anything_runs(
    arguments: list[str], said: str, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    inputs("a", "b")
    Path("broken.txt").write_text("svo in/a out/a.svo.pb\nsvo 'in/b out/b.svo.pb\n")
    assert batch(*arguments) == 2
    error = capsys.readouterr().err
    assert said in error
    assert error.count("\n") == 1
    assert not Path("out").exists()
    assert not Path("run").exists()


@pytest.mark.parametrize(
    ("words", "code"), [(["fine"], 0), (["fine", "broken"], 1), (["poor", "fine"], 3), (["poor", "killed"], 1)]
)
def test_the_exit_code_says_what_became_of_all(
    words: list[str], code: int, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    names = [inputs(f"{word}.npz", word=word)[0] for word in words]
    assert batch(TEMPLATE, *names, "--state", "run", "--report", "r.html") == code
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err.splitlines()[-1].startswith(f"{len(words)} item")
    assert batch("--state", "run", "--report", "r.html", "-q") == code  # judged again, and nothing is run


def test_a_lock_and_a_report_that_cannot_be_written_are_exit_code_4(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    Path("run").mkdir()
    Path("run/lock.0-of-1").write_text(json.dumps({"pid": os.getpid(), "host": "elsewhere"}))
    assert batch(TEMPLATE, *inputs("a"), "--state", "run") == 4
    assert capsys.readouterr().err == (
        f"error: run/lock.0-of-1: is in use by process {os.getpid()} on elsewhere; "
        "allowed: to wait for it, or --take-over\n"
    )
    assert batch(TEMPLATE, *inputs("a"), "--state", "run", "--take-over", "-q") == 0
    assert batch(TEMPLATE, *inputs("a"), "--state", "run", "--report", "in/a/r.html") == 4
    assert batch(TEMPLATE, *inputs("a"), "--state", "in/a") == 4


def test_no_inputs_are_fine_where_that_was_said(folder: Path) -> None:
    assert batch(TEMPLATE, "--state", "run", "--allow-empty", "-q") == 0
    assert batch("--state", "run", "-q") == 0


def test_the_plan_is_a_file_of_lines_that_gives_the_same_outputs(
    folder: Path, capfdbinary: pytest.CaptureFixture[bytes]
) -> None:
    names = ["a b.npz", 'it\'s {in} "x".npz', "line\nbreak.npz", "-dash.npz", os.fsdecode(b"\xff.npz"), "#a.npz"]
    paths = inputs(*names)
    assert batch(TEMPLATE, *paths, "--plan") == 0
    plan = capfdbinary.readouterr().out
    assert b"#   reads: 'in/a b.npz'\n#   writes: 'out/a b.svo.pb'\n" in plan
    Path("jobs.txt").write_bytes(plan)
    assert not Path("out").exists()
    assert batch("--jobs-file", "jobs.txt", "--state", "run", "-q") == 0
    outputs = {path.name: path.read_bytes() for path in Path("out").glob("*.svo.pb")}
    assert outputs == {f"{name.removesuffix('.npz')}.svo.pb": b"fine\n" + os.fsencode(name) for name in names}
    assert batch("--jobs-file", "jobs.txt", "--plan", "--shard", "1/6", "--json") == 0
    (line,) = capfdbinary.readouterr().out.splitlines()
    assert json.loads(line)["argv"] == ["svo", paths[1], f"out/{names[1].removesuffix('.npz')}.svo.pb"]


def test_json_lines_come_as_items_end(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    paths = [*inputs("a"), *inputs("b", word="broken")]
    assert batch(TEMPLATE, *paths, "--state", "run", "--json", "-q", "-j", "1") == 1
    events = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [(event["event"], event["status"]) for event in events] == [("end", "done"), ("end", "failed")]
    assert events[0]["outputs"][0]["path"] == "out/a.svo.pb"
    assert events[0]["psnr"] == 34.93
    assert batch(TEMPLATE, *paths, "--state", "run", "--json", "-q") == 1
    kinds = [json.loads(line)["event"] for line in capsys.readouterr().out.splitlines()]
    assert sorted(kinds) == ["end", "skip"]
    assert batch("--state", "run", "--json", "-q") == 1
    items = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [item["status"] for item in items] == ["done", "failed"]


def test_the_snakefile_is_where_it_says(capfd: pytest.CaptureFixture[str]) -> None:
    assert batch("--snakefile") == 0
    text = Path(capfd.readouterr().out.strip()).read_text()
    assert "nerfbake batch --jobs-file" in text
    assert len(text.splitlines()) < 30


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_batch_that_is_stopped_says_so(number: int, folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def interrupt() -> None:
        while not Path("out/a.svo.pb.begun").exists():
            time.sleep(0.01)
        os.kill(os.getpid(), number)

    threading.Thread(target=interrupt).start()
    assert batch(TEMPLATE, *inputs("a.npz", word="slow"), "--state", "run") == 128 + number
    assert capsys.readouterr().err.splitlines()[-1] == f"1 item: 1 killed; stopped by {signal.Signals(number).name}"
    assert not Path("run/lock.0-of-1").exists()


# -- nerfbake itself as the child ------------------------------------------------------------------------------
@pytest.fixture(scope="module")
def scenes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("scenes")
    for seed in range(3):
        save(folder / f"{seed}.npz", sample_n3tree(resolution=8, basis="SH1", seed=seed))
    (folder / "bad.npz").write_bytes((folder / "0.npz").read_bytes()[:2000])
    return folder


@pytest.mark.slow
def test_a_batch_writes_what_a_loop_writes(
    scenes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    paths = sorted(map(str, scenes.glob("*.npz")))
    assert batch(TEMPLATE, *paths, "--state", "run", "-j", "2", "--report", "report.csv") == 1
    assert "bad.npz: " in capsys.readouterr().err
    for path in paths:
        run(["svo", path, f"loop-{Path(path).stem}.svo.pb", "-q"])
    for seed in range(3):
        assert Path(f"out/{seed}.svo.pb").read_bytes() == Path(f"loop-{seed}.svo.pb").read_bytes()
    assert sorted(path.name for path in Path("out").iterdir()) == [f"{seed}.svo.pb" for seed in range(3)]
    assert [line for line in Path("report.csv").read_text().splitlines() if ",failed,1," in line]


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="other systems do not tell children that their parent has died")
def test_children_end_with_a_batch_that_is_killed(tmp_path: Path) -> None:
    pipe = tmp_path / "never.npz"
    os.mkfifo(pipe)  # whoever opens it waits
    command = [sys.executable, "-m", "nerfbake", "batch", "info {in}", str(pipe), "--state", str(tmp_path / "run")]
    parent = subprocess.Popen(command, cwd=tmp_path, env=os.environ | {"PYTHONPATH": str(REPOSITORY)})
    while not (found := _below(parent.pid)):
        time.sleep(0.02)
    time.sleep(1)  # until the child has come to what it reads
    parent.kill()
    parent.wait()
    deadline = time.monotonic() + 20
    while _lives(found[0]):
        assert time.monotonic() < deadline
        time.sleep(0.02)


def _below(pid: int) -> list[int]:
    """Processes that a process has started in whichever thread."""
    tasks = Path(f"/proc/{pid}/task").glob("*/children")
    return [int(word) for task in tasks for word in task.read_text().split()]


def _lives(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False
