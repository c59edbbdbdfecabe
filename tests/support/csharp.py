"""Compile the C# code of engines/unity with Mono, and run its reader in a process that answers one line per request."""

from __future__ import annotations

import shutil
import subprocess
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from tests.conftest import REPOSITORY

PACKAGE = REPOSITORY / "engines" / "unity"
READER = sorted((PACKAGE / "Runtime" / "Octree").glob("*.cs"))
PATIENCE = 60  # seconds for an answer; then the reader is killed


def require_mono() -> None:
    for program, package in (("mcs", "mono-mcs"), ("mono", "mono-runtime")):
        if shutil.which(program) is None:
            pytest.skip(f"no {program}: `make tools` installs {package}")


def compile_csharp(target: Path, *sources: Path, references: tuple[Path, ...] = ()) -> str:
    """Compile an .exe or a .dll as C# 5, and return the messages of the compiler, including warnings."""
    kind = "library" if target.suffix == ".dll" else "exe"
    command = ["mcs", "-langversion:5", "-warn:4", f"-target:{kind}", f"-out:{target}"]
    command += [f"-reference:{reference}" for reference in references]
    done = subprocess.run([*command, *sources], capture_output=True, text=True, check=False)
    assert (done.returncode == 0) == target.exists(), done.stdout + done.stderr
    return done.stdout + done.stderr


class Reader:
    """Sends requests to the process of the C# reader."""

    def __init__(self, process: subprocess.Popen[str], folder: Path) -> None:
        self._process, self._folder = process, folder

    def ask(self, *words: str | Path) -> list[str]:
        """Send a request and return the fields of the answer: 'ok', 'refused' or 'crashed', then its values."""
        assert self._process.stdin
        assert self._process.stdout
        timer = threading.Timer(PATIENCE, self._process.kill)
        timer.start()
        try:
            self._process.stdin.write("\t".join(map(str, words)) + "\n")
            self._process.stdin.flush()
            answer = self._process.stdout.readline()
        finally:
            timer.cancel()
        assert answer.endswith("\n"), f"no answer to {words}"
        return answer[:-1].split("\t")

    def facts(self, path: Path) -> tuple[list[str], npt.NDArray[np.int32], npt.NDArray[np.float32]]:
        """Read a file and return its header fields, children (c, 8) and values (n, D)."""
        target = self._folder / "found"
        kind, *words = self.ask("read", path, target)
        assert kind == "ok", words
        n, d = int(words[5]), int(words[6])
        raw = target.read_bytes()
        children = np.frombuffer(raw[: len(raw) - 4 * n * d], np.int32).reshape(-1, 8)
        return words, children, np.frombuffer(raw[len(raw) - 4 * n * d :], np.float32).reshape(n, d)

    def asked(self, what: str, path: Path, given: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
        """Send an array of floats with a request, and return the array of floats that the reader computes."""
        points, target = self._folder / "given", self._folder / "found"
        points.write_bytes(given.tobytes())
        kind, *words = self.ask(what, path, points, target)
        assert kind == "ok", words
        return np.frombuffer(target.read_bytes(), np.float32)


@contextmanager
def csharp_reader(folder: Path) -> Iterator[Reader]:
    """Compile the reader and start it. Skips the test if Mono is not installed."""
    require_mono()
    program = folder / "check.exe"
    said = compile_csharp(program, *READER, REPOSITORY / "tests" / "engines" / "unity" / "Check.cs")
    assert said == ""
    process = subprocess.Popen(["mono", program], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    with process:
        yield Reader(process, folder)
        assert process.stdin
        process.stdin.close()
