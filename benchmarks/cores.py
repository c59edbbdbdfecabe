"""Benchmark of the use of all cores: the work of each command that one thread does alone.

Each command is a whole process with one thread, with two, and with as many as there are cores. Two figures say how much
of it is serial. Alone: CPU seconds of the main thread outside of work that it shares with others (benchmarks.alone);
other work on the machine does not change them. Serial: the wall-clock seconds minus the CPU seconds beyond them, which
also counts what threads wait for each other; it is right only on a machine that does nothing else.

The chair's photographs are fitted with few cells, which is what the other commands read. Poses are found for a few
photographs of a capture.
"""

from __future__ import annotations

import json
import shutil
import sys
from pathlib import Path
from typing import Any, NamedTuple

from benchmarks.processes import announced, measure_process
from benchmarks.scenes import Scenes
from nerfbake.bench.environment import environment
from nerfbake.bench.report import Report, Table
from nerfbake.kernels.parallel import cores

COLUMNS = ["command", "threads", "wall s", "CPU s", "serial s", "alone s", "share alone %"]
NOTES = [
    "wall, CPU: of the whole process, the run with the least wall time of those that compile no kernel.",
    "serial: with n threads, (n wall - CPU) / (n - 1). alone: CPU seconds of the main thread outside of shared work; "
    "for `poses`, those of intervals of 0.2 s in which one of its threads does nearly all the work.",
]
CELLS = "64"  # of the fit, an axis
FIT = ("--preset", "fast", "--resolution", CELLS)
OPTIONS = ("--force", "-q")
PHOTOGRAPHS = 8
PICTURES = ("--frames", "12", "--edge", "200")


class Run(NamedTuple):
    """Wall-clock seconds of a run, its CPU seconds, and those that one thread worked alone."""

    wall: float
    worked: float
    alone: float


class Command(NamedTuple):
    """A command and its arguments. {photographs}, {scene}, {poses}: the inputs; {out}: a path without an extension."""

    name: str
    words: tuple[str, ...]


COMMANDS = (
    Command("fit", ("{photographs}", "{out}.npz", *FIT)),
    Command("mesh", ("{scene}", "{out}.glb", "--triangles", "2k", *PICTURES)),
    Command("splats", ("{scene}", "{out}.spz", "--count", "5k", *PICTURES)),
    Command("compress", ("{scene}", "{out}.svoq")),
    Command("view", ("{scene}", "{out}.html")),
    Command("poses", ("{poses}",)),
)


def reports(scenes: Scenes, *, rounds: int = 2) -> dict[str, list[Report]]:
    """Measure every command in rounds."""
    folder = scenes.folder / "cores"
    folder.mkdir()
    with announced("fitting the scene of the other commands"):
        scene = folder / "scene.npz"
        measure_process(sys.executable, "-m", "nerfbake", "fit", scenes.capture, scene, *FIT, "-q")
    poses = folder / "poses"
    poses.mkdir()
    for photograph in sorted((scenes.captures / "plush" / "images").iterdir())[:PHOTOGRAPHS]:
        shutil.copy(photograph, poses)
    places = {"photographs": scenes.capture, "scene": scene, "poses": poses, "out": folder / "out"}
    threads = sorted({1, 2, cores()})
    rows: list[list[Any]] = []
    for command in COMMANDS:
        words = [command.name, *(word.format(**places) for word in command.words), *OPTIONS]
        rows += [_row(command, count, _fastest(command, words, count, folder, rounds)) for count in threads]
    head = {
        "scene": f"the chair's photographs, and a fit of them with {CELLS} cells an axis; plush for `poses`",
        "rounds": str(rounds),
        **environment("numpy", "numba", "nerfbake", "pycolmap"),
    }
    return {"cores": [Report("All cores", head, [Table("Serial work", COLUMNS, rows)], NOTES)]}


def _fastest(command: Command, words: list[str], threads: int, folder: Path, rounds: int) -> Run:
    """Run a command, and return the run with the least wall time of those that compiled nothing."""
    facts, found = folder / "facts.json", list[Run]()
    while len(found) < rounds:
        with announced(f"{command.name} with {threads} threads"):
            run = (sys.executable, "-m", "benchmarks.alone", str(facts), *words)
            result = measure_process(*run, environment={"NUMBA_NUM_THREADS": str(threads)})
        told = json.loads(facts.read_text())
        if not told["compiled"]:
            found.append(Run(result.seconds, result.facts["worked"], told["alone"]))
    return min(found)


def _row(command: Command, threads: int, run: Run) -> list[Any]:
    if threads == 1:
        return [command.name, threads, run.wall, run.worked, None, None, None]
    serial = (threads * run.wall - run.worked) / (threads - 1)
    return [command.name, threads, run.wall, run.worked, serial, run.alone, 100 * run.alone / run.worked]
