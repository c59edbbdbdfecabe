"""The compiler of all kernels."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numba

import nerfbake.kernels.jit  # noqa: F401 (it updates the counters)
from nerfbake.kernels.compile_times import compiling


def test_the_seconds_of_the_compiler_are_told_apart() -> None:
    before = compiling()
    double = numba.njit(lambda x: x * 2)  # kept nowhere, so that every run compiles it
    assert compiling() == before
    assert double(2.0) == 4.0
    first = compiling()
    assert first.worked > before.worked
    assert first.passed > before.passed
    assert double(3.0) == 6.0
    assert compiling() == first


OLD = """
from typing import NamedTuple
from nerfbake.kernels.jit import compiled
class {name}(NamedTuple):
    x: float
@compiled()
def twice(pair):
    return pair.x * 2
print(twice({name}(3.0)))
"""


def test_a_cache_of_an_older_version_is_compiled_anew(tmp_path: Path) -> None:
    """The index of the first run refers to a type that the second version of the module has renamed."""
    environment = os.environ | {"PYTHONPATH": str(tmp_path), "NUMBA_CACHE_DIR": str(tmp_path / "cache")}
    for name in ("Old", "New"):
        (tmp_path / "versioned.py").write_text(OLD.format(name=name))
        command = [sys.executable, "-c", "import versioned"]
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
        assert (done.stdout, done.stderr) == ("6.0\n", "")
    assert list((tmp_path / "cache").rglob("*.nbi"))
