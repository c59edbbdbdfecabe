"""What a command says while it works."""

from __future__ import annotations

import os
import pty
import subprocess
import sys
from pathlib import Path

import pytest

from tests.conftest import Shell


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


def test_a_long_step_shows_how_much_of_it_is_done() -> None:
    code = """if True:
        import time
        from nerfbake.cli.words import Words
        with Words(quiet=False, verbose=True).progress("fitting") as tell:
            for share in (0.1, 0.42):
                tell(share, "stage 2, 31.25 dB, [/red].npz")
                time.sleep(0.3)"""
    leader, follower = pty.openpty()
    subprocess.run([sys.executable, "-c", code], stderr=follower, check=True)
    os.close(follower)
    shown = os.read(leader, 1 << 16)
    os.close(leader)
    for words in (b"fitting: stage 2, 31.25 dB, [/red].npz", b"42%"):
        assert words in shown
    (said,) = subprocess.run([sys.executable, "-c", code], capture_output=True, check=True).stderr.splitlines()
    assert said.startswith(b"fitting: 0.6")
