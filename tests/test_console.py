"""What a command says while it works."""

from __future__ import annotations

import fcntl
import os
import pty
import re
import struct
import subprocess
import sys
import termios
import time
from contextlib import suppress
from pathlib import Path

import pytest

from nerfbake.console import ConsoleStep
from tests.support.outputs import read_output

SLOW_STEP = """if True:
    import sys, time
    from nerfbake import progress
    from nerfbake import console
    console.EVERY |= {"plain": 0.3, "json": 0.3}
    with console.Console(quiet=False, verbose=False, mode=sys.argv[1]).phase("thinking hard") as tell:
        time.sleep(1.2)
        tell("stage 2, 31.25 dB, [/red].npz, and more that does not fit on a line of 80 characters")
        for tenth in range(1, 8):
            progress.report(tenth / 10)
            time.sleep(0.2)"""


def on_a_terminal(code: str, *arguments: str, columns: int = 80) -> str:
    """What a terminal of this width is sent."""
    leader, follower = pty.openpty()
    fcntl.ioctl(follower, termios.TIOCSWINSZ, struct.pack("HHHH", 24, columns, 0, 0))
    subprocess.run([sys.executable, "-c", code, *arguments], stderr=follower, check=True)
    os.close(follower)
    shown = b""
    with suppress(OSError):
        while piece := os.read(leader, 1 << 16):
            shown += piece
    os.close(leader)
    return re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", shown.decode())


def in_a_pipe(code: str, *arguments: str) -> list[str]:
    done = subprocess.run([sys.executable, "-c", code, *arguments], capture_output=True, check=True, text=True)
    return done.stderr.splitlines()


@pytest.mark.long
def test_a_terminal_sees_how_much_is_done_and_the_time_left() -> None:
    lines = [line for line in re.split(r"[\r\n]+", on_a_terminal(SLOW_STEP, "auto")) if "stage 2" in line]
    moved = [line for line in lines if re.search(r" [2-7]0% ", line)]  # at the first share, 10%, no rate is known
    assert len(moved) >= 3
    assert all(re.search(r"thinking hard: stage 2.*… .* \d+% 0:0\d left$", line) for line in moved), lines
    assert {len(line) for line in lines} == {80}
    assert " 70% " in lines[-1]


def test_a_pipe_sees_nothing_unless_it_is_asked_for() -> None:
    assert in_a_pipe(SLOW_STEP, "auto") == []


@pytest.mark.long
def test_plain_lines_have_a_share_and_a_time_left() -> None:
    lines = in_a_pipe(SLOW_STEP, "plain")
    assert 3 <= len(lines) <= 8
    assert all(line.startswith("thinking hard: stage 2, 31.25 dB") for line in lines)
    assert re.search(r" [1-7]0 %, 0:0\d( left)?$", lines[-1])


def test_json_lines_have_shares_and_seconds() -> None:
    events = [read_output("progress", line) for line in in_a_pipe(SLOW_STEP, "json")]
    assert len(events) >= 3
    last = events[-1]
    assert (last["version"], last["event"], last["step"], last["compiling"]) == (1, "progress", "thinking hard", False)
    assert 0.3 <= last["share"] <= 0.7
    assert 0 < last["seconds_left"] < 4
    assert 1.5 < last["seconds"] < 5


@pytest.mark.long
def test_one_bar_shows_the_innermost_of_two_steps() -> None:
    code = """if True:
        import time
        from nerfbake.console import Console
        words = Console(quiet=False, verbose=False)
        with words.phase("judging"):
            time.sleep(1.3)
            with words.phase("reading a file"):
                time.sleep(1.3)"""
    shown = on_a_terminal(code)
    assert "judging" in shown
    assert "reading a file" in shown
    assert "Traceback" not in shown


def test_the_time_left_is_that_of_this_run() -> None:
    """A fit that goes on begins at half of its work: that half took no time here."""
    step = ConsoleStep("fitting")
    step.report(0.5, "")
    assert step.seconds_left is None
    step._first = (time.perf_counter() - 10, 0.5)
    step.report(0.75, "")
    assert step.seconds_left == pytest.approx(10, abs=0.5)
    step.report(0.6, "")  # never backwards
    assert step.share == 0.75


def test_kernels_that_are_compiled_are_told(tmp_path: Path) -> None:
    code = """if True:
        import sys
        from nerfbake import console
        console.PATIENCE, console.EVERY["plain"] = 0.05, 0.05
        with console.Console(quiet=False, verbose=False, mode="plain").phase("rendering"):
            import nerfbake.kernels.maths.linear as products
            import numpy as np
            products.product(np.eye(3), np.eye(3))"""
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, check=True, text=True)
    assert "compiling kernels, once on this machine: " in done.stderr
