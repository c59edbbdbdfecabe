"""Run the command-line tools of the formats (flatc, capnp, protoc) as references."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.conftest import REPOSITORY

SCHEMAS = REPOSITORY / "schemas"
NEEDED = {"flatc": "flatbuffers-compiler", "capnp": "capnproto"}


def tool(name: str, *arguments: str | Path, stdin: bytes = b"") -> bytes:
    """Run a tool and return its output. Skips the test if the tool is not installed."""
    if shutil.which(name) is None:
        pytest.skip(f"no {name} here: Debian's {NEEDED[name]} has it ('make tools' as root installs it)")
    return _run([name, *map(str, arguments)], stdin)


def protoc(*arguments: str | Path, stdin: bytes = b"") -> bytes:
    """Run protoc, which comes with a Python package, and return its output."""
    return _run([sys.executable, "-W", "ignore", "-m", "grpc_tools.protoc", *map(str, arguments)], stdin)


def _run(command: list[str], stdin: bytes) -> bytes:
    done = subprocess.run(command, input=stdin, capture_output=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout
