"""What a command prints for scripts."""

from __future__ import annotations

import json
from typing import Any

import pytest

from nerfbake.cli.main import run


def told(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> Any:
    capsys.readouterr()
    assert run([*arguments, "--json"]) == 0
    return json.loads(capsys.readouterr().out)
