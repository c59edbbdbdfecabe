"""Time and peak memory of `nerfbake svo` as whole processes, compared with np.load of the same file, and its scaling.

Comparisons are ratios of runs that take turns on the same machine; absolute times are only context. Peak memory is the
operating system's figure for the finished process. Modules are compiled before the clock starts, as in an installation.
Outputs are new files, because a file system takes longer to replace a file. If the real chair is missing, its rows
report that.
"""

from __future__ import annotations

import statistics
import sys
import tempfile
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.processes import announced, in_turn, measure_process
from benchmarks.scenes import Scenes
from nerfbake import N3Tree, build_octree, load
from nerfbake.bench.environment import environment
from nerfbake.bench.measure import Result, Statistics, Work, measure
from nerfbake.bench.report import Report, Table

ROUNDS, BUILDS = 7, 5
SH16 = "sample_sh16"
TREES = (("chair_sh9", 128), ("chair_sh9", 256), (SH16, 128), (SH16, 256), ("chair_sh9_128_quant", 128))
SCALING = ("sample_128", "sample_256", "sample_512")
NERFBAKE = (sys.executable, "-m", "nerfbake")
BARE = "import numpy, click, nerfbake.cli.main"
NP_LOAD = "import sys, numpy as np\nwith np.load(sys.argv[1]) as npz:\n    arrays = [npz[key] for key in npz.files]"
WHOLE = ["tree", "decoded MB", "resolution", "svo s", "np.load s", "ratio of pairs", "peak MB", "peak x decoded"]
WHOLE += ["without imports", "file MB"]
NOTES = [
    "np.load s: a Python process that np.loads every array of the same file. Median [min..max].",
    "peak: of the whole process, the median over its rounds; without imports: less the peak of a process that only "
    "imports NumPy, click and the commands.",
    "Scaling: sample trees at their own resolution; each process has built the tree once before the measured build.",
]


def reports(scenes: Scenes, *, rounds: int = ROUNDS) -> dict[str, list[Report]]:
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "out.svo.pb"
        ((imports,),) = in_turn(partial(measure_process, sys.executable, "-c", BARE), rounds=1)
        tables = [
            Table("Whole processes", WHOLE, [_tree_row(scenes, *tree, out, imports.peak, rounds) for tree in TREES]),
            Table("The chair at 256^3", ["layout", "no child = 0, MB", "no child = -1, MB"], _child_rows(scenes, out)),
        ]
    columns = ["sample", "tree nodes", "octree nodes", "build ms", "microseconds a node"]
    tables.append(Table("Scaling", columns, [_scaling_row(scenes, name, min(rounds, BUILDS)) for name in SCALING]))
    head = {
        "rounds": str(rounds),
        "imports alone": f"{imports.peak / 1e6:.0f} MB",
        **environment("numpy", "deflate", "nerfbake"),
    }
    return {"svo": [Report("nerfbake svo, measured", head, tables, NOTES)]}


def _tree_row(scenes: Scenes, name: str, resolution: int, out: Path, bare: int, rounds: int) -> list[Any]:
    """The row of one tree at one resolution."""
    tree = scenes.sample(name) if name == SH16 else scenes.chairs / f"{name}.npz"
    if not tree.exists():
        return [f"{name}: not there", *[None] * (len(WHOLE) - 1)]
    svo = (*NERFBAKE, "svo", tree, out, "--resolution", str(resolution), "-q")
    floor = (sys.executable, "-c", NP_LOAD, tree)
    with announced(f"{name} at {resolution}^3: {rounds} rounds in turn"):
        theirs, ours = in_turn(partial(_fresh, out, *floor), partial(_fresh, out, *svo), rounds=rounds)
    decoded = _decoded_bytes(tree)
    peak = statistics.median(run.peak for run in ours)
    return [
        name,
        decoded / 1e6,
        f"{resolution}^3",
        Statistics.of([run.seconds for run in ours]),
        Statistics.of([run.seconds for run in theirs]),
        Statistics.of([a.seconds / b.seconds for a, b in zip(ours, theirs, strict=True)]),
        peak / 1e6,
        peak / decoded,
        (peak - bare) / decoded,
        out.stat().st_size / 1e6,
    ]


def _fresh(out: Path, *command: str | Path) -> Result:
    """Delete the output, and measure the command that writes it."""
    out.unlink(missing_ok=True)
    return measure_process(*command)


def _decoded_bytes(archive: Path) -> int:
    with np.load(archive) as arrays:
        return sum(arrays[name].nbytes for name in arrays.files)


def _child_rows(scenes: Scenes, out: Path) -> list[list[Any]]:
    """File sizes with either value for "no child"."""
    if not scenes.chair.exists():
        return [[f"{scenes.chair.name}: not there", None, None]]
    rows: list[list[Any]] = []
    for layout in ("full", "compact"):
        sizes = []
        for spelling in ("0", "-1"):
            _fresh(out, *NERFBAKE, "svo", scenes.chair, out, "--layout", layout, f"--no-child={spelling}", "-q")
            sizes.append(out.stat().st_size / 1e6)
        rows.append([f"svo.pb {layout}", *sizes])
    return rows


def _scaling_row(scenes: Scenes, name: str, rounds: int) -> list[Any]:
    """The row of a sample at its own resolution; the time per octree node must be constant over the rows."""
    tree = str(scenes.sample(name))
    with announced(f"building {name}: {rounds} rounds"):
        builds = [measure(building, path=tree) for _ in range(rounds)]
    facts = builds[0].facts
    times = Statistics.of([build.seconds * 1e3 for build in builds])
    return [name, facts["tree nodes"], facts["octree nodes"], times, times.median * 1e3 / facts["octree nodes"]]


def building(path: str) -> Work:
    """The work of building a tree's octree for the second time; called in a child process."""
    tree = load(path, N3Tree)
    build_octree(tree)
    return Work(
        lambda: build_octree(tree),
        lambda octree: {"tree nodes": sum(map(len, tree.levels)), "octree nodes": octree.n},
    )
