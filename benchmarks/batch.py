"""Compare nerfbake batch with a shell loop, make and Snakemake on many scenes, with one job and with two.

Every engine runs the same commands on the same files; the engines take turns. `again` is a second run, when all outputs
exist. The shell loop bakes all scenes again.
"""

from __future__ import annotations

import os
import shutil
import sys
import tempfile
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

from benchmarks.processes import announced, measure_process
from benchmarks.scenes import Scenes
from nerfbake.bench.environment import environment
from nerfbake.bench.measure import Statistics
from nerfbake.bench.report import Report, Table

SCENES = 16
EXAMPLES = Path(__file__).parents[1] / "examples"
COLUMNS = ["engine", "jobs", "s", "scenes a minute", "again s", "the loop's bytes"]
NOTES = [
    "s: from the start to the end of all scenes; each scene is a separate process.",
    "Snakemake runs the package's Snakefile, with a shard for each job.",
]


class Engine(NamedTuple):
    """A shell command that bakes all scenes, and the module that it needs."""

    name: str
    jobs: int
    line: str
    module: str = ""


_BATCH = "nerfbake batch 'svo {{in}} baked/{{stem}}.svo.pb' scenes/*.npz --state run -q -j {jobs}"
_SNAKE = f"{sys.executable} -m snakemake --quiet -c {{jobs}} --config shards={{jobs}} threads=1"
ENGINES = (
    Engine("shell loop", 1, "mkdir -p baked; sh loop.sh"),
    *(Engine("make", jobs, f"make -s -j{jobs}") for jobs in (1, 2)),
    *(Engine("nerfbake batch", jobs, _BATCH.format(jobs=jobs)) for jobs in (1, 2)),
    *(Engine("Snakemake", jobs, _SNAKE.format(jobs=jobs), "snakemake") for jobs in (1, 2)),
)
_LOOP = 'for f in scenes/*.npz; do nerfbake svo "$f" "baked/$(basename "$f" .npz).svo.pb" --force -q; done\n'


def reports(scenes: Scenes, *, rounds: int = 3) -> dict[str, list[Report]]:
    """Measure whole batches; the engines take turns."""
    tree = scenes.sample("sample_128")
    with tempfile.TemporaryDirectory() as folder:
        table = Table(f"{SCENES} scenes", COLUMNS, _rows(tree, Path(folder), rounds))
    head = {"scene": f"{tree.name}, {tree.stat().st_size / 1e6:.1f} MB, {SCENES} times"}
    versions = environment("numpy", "numba", "snakemake")
    return {"batch": [Report("Many scenes", {**head, **versions}, [table], NOTES)]}


def _rows(tree: Path, folder: Path, rounds: int) -> list[list[Any]]:
    first: dict[Engine, list[float]] = {}
    again: dict[Engine, list[float]] = {}
    same: dict[Engine, bool] = {}
    loop: dict[str, bytes] = {}
    there = [engine for engine in ENGINES if not engine.module or find_spec(engine.module)]
    for count in range(rounds):
        for engine in there:
            with announced(f"{engine.name}, {engine.jobs} at a time, round {count + 1}"):
                place = _prepared(tree, folder / f"{engine.name} {engine.jobs} {count}")
                first.setdefault(engine, []).append(_seconds(engine, place))
                baked = {path.name: path.read_bytes() for path in (place / "baked").iterdir()}
                again.setdefault(engine, []).append(_seconds(engine, place))
                loop = loop or baked
                same[engine] = same.get(engine, True) and baked == loop
                shutil.rmtree(place)
    rows: list[list[Any]] = []
    for engine in ENGINES:
        if engine not in first:
            rows.append([f"{engine.name}: not installed", engine.jobs, None, None, None, None])
            continue
        taken = Statistics.of(first[engine])
        rows.append(
            [engine.name, engine.jobs, taken, 60 * SCENES / taken.median, Statistics.of(again[engine]), same[engine]]
        )
    return rows


def _prepared(tree: Path, place: Path) -> Path:
    """Create a folder with the scenes and the files of the engines."""
    shutil.copytree(EXAMPLES, place)
    (place / "scenes").mkdir()
    (place / "loop.sh").write_text(_LOOP)
    for number in range(SCENES):
        os.link(tree, place / "scenes" / f"{number}.npz")
    return place


def _seconds(engine: Engine, place: Path) -> float:
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    command = f"cd '{place}' && {engine.line} >/dev/null 2>log"
    return measure_process("sh", "-c", command, environment={"PATH": path}).seconds
