"""What reaches the user when things go wrong around a command: one line, a documented exit code, no traceback."""

from __future__ import annotations

import os
import pty
import signal
import subprocess
import sys
from pathlib import Path

import click
import pytest

from nerfbake import sample_n3tree, save
from nerfbake.cli import main
from nerfbake.cli.main import run
from nerfbake.errors import LONGEST_LINE, OutputError, PipeClosed
from tests.conftest import Shell


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("guard")
    save(folder / "a.npz", sample_n3tree(resolution=16, basis="SH1"))
    return folder


def bash(script: str, folder: Path, **variables: str) -> subprocess.CompletedProcess[str]:
    command = ["bash", "-c", f"set -o pipefail; nerfbake() {{ '{sys.executable}' -m nerfbake \"$@\"; }}; {script}"]
    environment = os.environ | variables
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)


@pytest.mark.parametrize(
    ("script", "code", "said"),
    [
        ("nerfbake info a.npz >&-", 4, "error: stdout: is closed"),
        ("nerfbake svo a.npz - --to svo.pb >&-", 4, "error: stdout: is closed"),
        ("nerfbake svo a.npz - --to svo.pb > /dev/full", 4, "error: stdout: No space left on device"),
        ("nerfbake info a.npz > /dev/full", 4, "error: stdout: No space left on device"),
        ("nerfbake check nope.npz > /dev/full", 4, "error: stdout: No space left on device"),
        ("nerfbake --help > /dev/full", 4, "error: No space left on device"),
        ("nerfbake svo a.npz /dev/full --to svo.pb", 4, "error: /dev/full: No space left on device"),
        ("nerfbake info - <&-", 1, "error: stdin: is closed"),
        ("nerfbake info - < /dev/null", 1, "error: stdin: is empty"),
        ("nerfbake info a.npz <&- > /dev/null", 0, ""),
        ("nerfbake info a.npz 2>&- > /dev/null", 0, ""),
        ("nerfbake info nope.npz 2>&-", 1, ""),
        ("nerfbake info nope.npz 2> /dev/full", 1, ""),
        ("nerfbake svo a.npz b.svo.pb 2> /dev/full", 0, ""),
        ("nerfbake svo a.npz c.svo.pb <&- >&- 2>&-", 0, ""),
        ("nerfbake info a.npz | true", 141, ""),
        ("nerfbake --help | true", 141, ""),
        ("nerfbake svo a.npz - --to svo.pb | true", 141, ""),
        ("nerfbake info $'a\\nb\\x1b[2J'", 1, "error: a b [2J: No such file or directory"),
        ("mkdir d.svo.pb; nerfbake svo a.npz d.svo.pb", 4, "error: d.svo.pb: is a folder"),
    ],
)
def test_streams_of_every_kind(script: str, code: int, said: str, folder: Path) -> None:
    done = bash(script, folder)
    assert (done.returncode, done.stderr.count("\n")) == (code, 1 if said else 0), done.stderr
    assert done.stderr.startswith(said)


def test_what_is_written_while_streams_are_closed_is_whole(folder: Path) -> None:
    assert (
        bash("nerfbake svo a.npz closed.svo.pb <&- >&- 2>&- && nerfbake svo a.npz open.svo.pb", folder).returncode == 0
    )
    assert (folder / "closed.svo.pb").read_bytes() == (folder / "open.svo.pb").read_bytes()


def test_names_that_the_terminal_cannot_show_are_shown_all_the_same(folder: Path) -> None:
    name = "märchen\N{SNOWMAN}.npz"
    (folder / name).write_bytes((folder / "a.npz").read_bytes())
    done = bash(f"nerfbake info {name}", folder, PYTHONIOENCODING="ascii", PYTHONUTF8="0")
    assert done.returncode == 0
    assert "m\\xe4rchen\\u2603.npz" in done.stdout
    raw = os.fsdecode(b"\xff.npz")  # no UTF-8 at all
    (folder / raw).write_bytes((folder / "a.npz").read_bytes())
    done = bash("nerfbake info $'\\xff.npz'", folder)
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.parametrize(
    "fault",
    [
        ZeroDivisionError("division by zero"),
        RecursionError("too deep"),
        UnicodeError("no text"),
        KeyError("x" * 9999),
        EOFError("ran out of input"),  # click turns it into Abort, as it does Ctrl-C
        EOFError(),
    ],
)
def test_a_fault_of_our_own_is_one_line(
    fault: Exception, folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    @click.command()
    def broken() -> None:
        raise fault

    monkeypatch.setitem(main.cli.commands, "broken", broken)
    assert main.run(["broken"]) == main.OWN_FAULT
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"error: a bug in nerfbake: {type(fault).__name__} in ")
    assert "NERFBAKE_TRACEBACK=1" in line
    assert len(line) <= LONGEST_LINE + len("error: ")
    monkeypatch.setenv("NERFBAKE_TRACEBACK", "1")
    with pytest.raises(type(fault)):
        main.run(["broken"])


# Python drops what a finalizer raises. After a long kernel, the first Python code may be that of a finalizer.
IN_A_FINALIZER = """
import signal, sys, time, weakref
from nerfbake.cli import main

class Scene:
    pass

def work(*arguments, **options):
    weakref.finalize(Scene(), signal.raise_signal, {number})  # runs at once: nothing keeps the scene
    time.sleep(20)

main.cli.main = work
main.main()
"""


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_that_arrives_in_a_finalizer_stops_the_command(number: int, code: int) -> None:
    script = IN_A_FINALIZER.format(number=int(number))
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False, timeout=15)
    assert done.returncode == code
    assert done.stderr.strip() == ("error: stopped" if number == signal.SIGINT else "")


def test_warnings_do_not_reach_the_user_unless_asked_for(folder: Path) -> None:
    code = "import warnings, nerfbake.cli.main as m; m.run = lambda a: warnings.warn('boo') or 0; m.main()"
    for options, told in (([], False), (["-W", "default"], True)):
        done = subprocess.run([sys.executable, *options, "-c", code], capture_output=True, text=True, check=False)
        assert ("boo" in done.stderr) == told


def test_every_exit_code_is_documented() -> None:
    text = main.cli.get_help(click.Context(main.cli))
    for code in (0, 1, 2, 3, OutputError.exit_code, main.OWN_FAULT):
        assert f" {code} " in text.replace("\n", " ")
    assert PipeClosed.exit_code == 128 + 13


def test_a_read_only_installation_without_a_home_works(folder: Path) -> None:
    # numba finds no place for its cache, neither beside the modules nor in a home.
    code = """if True:
        import sys
        from numba.core.caching import CacheImpl
        CacheImpl._locator_classes = []
        from nerfbake.cli.main import run
        sys.exit(run(["hull", "a.npz", "a.glb", "-v"]))"""
    done = subprocess.run([sys.executable, "-c", code], cwd=folder, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "kernels are compiled again" in done.stderr
    assert (folder / "a.glb").exists()


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


def test_help_of_every_command_shows_a_line_to_paste(capsys: pytest.CaptureFixture[str]) -> None:
    for command in ("svo", "convert", "lod", "info", "check", "sample octree"):
        assert run([*command.split(), "--help"]) == 0
        assert f"  nerfbake {command} " in capsys.readouterr().out


def test_a_command_that_there_is_not(capsys: pytest.CaptureFixture[str]) -> None:
    assert main.run(["nonsense"]) == 2
    assert capsys.readouterr().err.startswith("error: No such command 'nonsense'")


@pytest.mark.parametrize("words", [[], ["sample"], ["bench"]])
def test_a_group_without_a_command_shows_its_help(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert run(words) == 2
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err.startswith(f"Usage: {' '.join(['nerfbake', *words])} [OPTIONS]")
    assert said.err.count("\n") > 5
