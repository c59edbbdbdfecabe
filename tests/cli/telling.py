"""What a command prints for scripts."""

from __future__ import annotations

from typing import Any

import pytest

from nerfbake.cli.main import run
from tests.support.outputs import read_output


def told(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> Any:
    """What it prints with --json, which is as its schema has it."""
    capsys.readouterr()
    assert run([*arguments, "--json"]) == 0
    return read_output(arguments[0], capsys.readouterr().out)
