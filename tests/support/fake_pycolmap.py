"""A module in the place of pycolmap, for the process that nerfbake.jobs._pycolmap runs in."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from tests.conftest import REPOSITORY

SLEEPS = """
import os, pathlib, time
pathlib.Path(__file__).with_name("started").write_text(str(os.getpid()))
time.sleep(60)
"""

CRASHES_ONCE = """
import os, pathlib, signal, sys
place = pathlib.Path(__file__)
crashed = place.with_name("crashed")
if not crashed.exists():
    crashed.touch()
    os.kill(os.getpid(), signal.SIGBUS)
sys.path.remove(str(place.parent))
del sys.modules["pycolmap"]
import pycolmap  # the real one
"""


def write_pycolmap(folder: Path, code: str) -> dict[str, str]:
    """Write the module to a folder; return the environment in which Python finds it and writes nothing beside it."""
    (folder / "pycolmap.py").write_text(code)
    return {"PYTHONPATH": f"{folder}{os.pathsep}{REPOSITORY}", "PYTHONDONTWRITEBYTECODE": "1"}


def replace_pycolmap(folder: Path, code: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let processes that this test starts find the module."""
    for name, value in write_pycolmap(folder, code).items():
        monkeypatch.setenv(name, value)
