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
