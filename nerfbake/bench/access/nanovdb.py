"""Trilinear reads by NanoVDB's own sampler: a small C++ program, compiled where the benchmark runs."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path
from shutil import which
from typing import Any

from nerfbake.bench.measure import Work
from nerfbake.errors import NerfbakeError

FLAGS = ("-O3", "-march=native", "-std=c++17", "-DNDEBUG")
SOURCE = Path(__file__).with_name("nanovdb_reader.cpp")
PROGRAM, MISSING = "nanovdb", "nanovdb.missing"  # in the folder that the rows read from


def compile_nanovdb(folder: Path) -> None:
    """Leaves the program in the folder, or a text that says why there is none."""
    missing = folder / MISSING
    if (compiler := which("g++")) is None:
        missing.write_text("no g++ here (Debian: g++)")
        return
    command = [compiler, *FLAGS, str(SOURCE), "-o", str(folder / PROGRAM)]
    english = {**os.environ, "LC_ALL": "C"}
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=english)
    if "nanovdb/util/IO.h: No such file" in done.stderr:
        missing.write_text("no headers of NanoVDB here (Debian: libnanovdb-dev)")
    elif done.returncode:
        missing.write_text(f"g++ {next(line for line in done.stderr.splitlines() if 'error' in line)}")


def reading_in_cpp(folder: Path, files: list[Path], *, stencil: bool) -> Work:
    """The work of reading density.nvdb at the points of each file, with the sampler's stencil cache or without."""
    if (missing := folder / MISSING).exists():
        raise NerfbakeError(missing.read_text())
    grid = folder / "density.nvdb"

    def run() -> str:
        command = [folder / PROGRAM, grid, "1" if stencil else "0", *files]
        return subprocess.run(command, check=True, capture_output=True, text=True).stdout

    def check(printed: str) -> dict[str, Any]:
        version, *lines = printed.splitlines()
        found = [[float(word) for word in line.split()] for line in lines]
        return {"found": found, "bytes": grid.stat().st_size, "version": version}

    return Work(run, check)
