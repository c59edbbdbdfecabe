"""Ctrl-C while modules are imported: exit code 130, one line, no traceback, whatever was being imported."""

from __future__ import annotations

import subprocess
import sys

import pytest

from nerfbake.__main__ import main

# Sends itself SIGINT when the n-th module is looked for, and prints how many there were.
CODE = """
import os, signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)
from nerfbake.__main__ import main
class Finder:
    left = int(sys.argv.pop(1))
    def find_spec(self, name, path=None, target=None):
        Finder.left -= 1
        if Finder.left == 0:
            os.kill(os.getpid(), signal.SIGINT)
sys.meta_path.insert(0, Finder())
main()
"""


@pytest.mark.parametrize("moment", [1, 2, 5, 20, 60, 150])
def test_ctrl_c_during_imports_is_one_line(moment: int) -> None:
    command = [sys.executable, "-c", CODE, str(moment), "sample", "octree", "-", "--resolution", "8"]
    done = subprocess.run(command, capture_output=True, check=False)
    assert (done.returncode, done.stderr.lstrip()) == (130, b"error: stopped\n")  # click ends the line of ^C first
    assert done.stdout == b""


def test_ctrl_c_before_the_command_line_is_parsed_is_one_line(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    def interrupted() -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("nerfbake.cli.main.main", interrupted)
    with pytest.raises(SystemExit) as stopped:
        main()
    assert (stopped.value.code, capfd.readouterr().err) == (130, "error: stopped\n")
