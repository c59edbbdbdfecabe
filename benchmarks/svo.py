"""`nerfbake svo` as whole processes: against np.load of the same file, its peak memory, and how it scales.

    python benchmarks/svo.py            rewrites benchmarks/results/svo.md

Comparisons are ratios of runs that take turns on the same machine; absolute times are only context. Peak memory is the
operating system's own figure for the finished process. Modules are compiled before the clock runs, as an installation
leaves them, and outputs are new files: a file system takes its time to replace one. Needs the real chair beside the
project; without it those rows say so.
"""

from __future__ import annotations

import atexit
import os
import platform
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import NamedTuple

HERE = Path(__file__).parent
DATA = Path(os.environ.get("NERFBAKE_DATA", HERE.parents[1] / "shared" / "data"))
CHAIRS = DATA / "plenoctree" / "chair"
CHAIR = CHAIRS / "chair_sh9.npz"
QUANTISED = CHAIRS / "chair_sh9_128_quant.npz"
RESULT = HERE / "results" / "svo.md"
ROUNDS = 7

NERFBAKE = [sys.executable, "-m", "nerfbake"]
PACK = "import sys, numpy as np\nwith np.load(sys.argv[1]) as npz:\n    np.savez_compressed(sys.argv[2], **npz)"
NP_LOAD = "import sys, numpy as np\nwith np.load(sys.argv[1]) as npz:\n    arrays = [npz[key] for key in npz.files]"


class Run(NamedTuple):
    """A finished process."""

    seconds: float
    peak: int  # bytes


def measure(command: list[str], out: Path | None = None) -> Run:
    """Wall time and peak memory of a whole process, whose output is not there before."""
    if out is not None:
        out.unlink(missing_ok=True)
    start = time.perf_counter()
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, env=compiled_modules())
    _, status, usage = os.wait4(process.pid, 0)
    seconds = time.perf_counter() - start
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise SystemExit(f"{' '.join(command)} exited with {process.returncode}")
    return Run(seconds, usage.ru_maxrss * 1024)


@cache
def compiled_modules() -> dict[str, str]:
    """The environment, with a folder where Python keeps what it has compiled."""
    folder = tempfile.mkdtemp(prefix="nerfbake-bench-")
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return {**os.environ, "PYTHONDONTWRITEBYTECODE": "", "PYTHONPYCACHEPREFIX": folder}


def in_turn(commands: list[list[str]], out: Path, rounds: int = ROUNDS) -> list[list[Run]]:
    """Every command once a round, after one round that does not count."""
    runs = [[measure(command, out) for command in commands] for _ in range(rounds + 1)][1:]
    return [list(of_command) for of_command in zip(*runs, strict=True)]


def spread(values: list[float], digits: int = 2) -> str:
    median, low, high = statistics.median(values), min(values), max(values)
    return f"{median:.{digits}f} [{low:.{digits}f}..{high:.{digits}f}]"


def decoded_size(archive: Path) -> int:
    """Bytes of all arrays, read in a process of its own: a child starts with its parent's peak memory as its own."""
    code = f"{NP_LOAD}\nprint(sum(array.nbytes for array in arrays))"
    done = subprocess.run([sys.executable, "-c", code, str(archive)], capture_output=True, text=True, check=True)
    return int(done.stdout)


def tree_rows(folder: Path) -> list[str]:
    """The real chair, plain and quantised, and a sample SH16 scene, deflated as svox does, against np.load."""
    sample, sh16 = folder / "stored.npz", folder / "sample_sh16.npz"
    measure([*NERFBAKE, "sample", "octree", str(sample), "--basis", "SH16", "--resolution", "256", "-q"])
    measure([sys.executable, "-c", PACK, str(sample), str(sh16)])
    bare = measure([sys.executable, "-c", "import numpy, click, nerfbake.cli.main"]).peak
    rows = [
        f"A process that imports NumPy and click alone peaks at {bare / 1e6:.0f} MB; in brackets without that.",
        "",
        "| tree | decoded MB | resolution | svo s, median [min..max] | np.load s | ratio of pairs | peak MB "
        "| peak / decoded | file MB |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for tree, resolution in ((CHAIR, 128), (CHAIR, 256), (sh16, 128), (sh16, 256), (QUANTISED, 128)):
        rows.append(tree_row(tree, resolution, folder, bare) if tree.exists() else f"| {tree.name} is not there |")
    return rows


def tree_row(tree: Path, resolution: int, folder: Path, bare: int) -> str:
    """One tree at one resolution."""
    out, decoded = folder / "out.svo.pb", decoded_size(tree)
    svo = [*NERFBAKE, "svo", str(tree), str(out), "--resolution", str(resolution), "-q"]
    floor = [sys.executable, "-c", NP_LOAD, str(tree)]
    theirs, ours = in_turn([floor, svo], out)
    ratios = [a.seconds / b.seconds for a, b in zip(ours, theirs, strict=True)]
    peak = statistics.median(run.peak for run in ours)
    return (
        f"| {tree.stem} | {decoded / 1e6:.1f} | {resolution}^3 | {spread([run.seconds for run in ours])} "
        f"| {spread([run.seconds for run in theirs])} | {spread(ratios)} | {peak / 1e6:.0f} "
        f"| {peak / decoded:.2f} ({(peak - bare) / decoded:.2f}) | {out.stat().st_size / 1e6:.1f} |"
    )


def child_rows(folder: Path) -> list[str]:
    """What the two spellings of "no child" cost on disk."""
    if not CHAIR.exists():
        return []
    rows = ["", "| chair at 256^3 | layout | no child = 0, MB | no child = -1, MB |", "|---|---|---|---|"]
    for layout in ("full", "compact"):
        sizes = []
        for spelling in ("0", "-1"):
            out = folder / "child.svo.pb"
            measure(
                [*NERFBAKE, "svo", str(CHAIR), str(out), "--layout", layout, f"--no-child={spelling}", "--force", "-q"]
            )
            sizes.append(f"{out.stat().st_size / 1e6:.1f}")
        rows.append(f"| svo.pb | {layout} | {' | '.join(sizes)} |")
    return rows


def scaling_rows(folder: Path) -> list[str]:
    """Sample trees of growing resolution, in process: time per octree node must stay flat."""
    rows = [
        "| sample | tree nodes | octree nodes | build s, median [min..max] | microseconds a node |",
        "|---|---|---|---|---|",
    ]
    for resolution in (128, 256, 512):
        tree = folder / f"sample_{resolution}.npz"
        measure([*NERFBAKE, "sample", "octree", str(tree), "--resolution", str(resolution), "-q"])
        code = (
            "import sys, time; from nerfbake import load, build_octree; tree = load(sys.argv[1]); build_octree(tree)\n"
            "for _ in range(5):\n    start = time.perf_counter(); octree = build_octree(tree)\n"
            "    print(time.perf_counter() - start, sum(map(len, tree.levels)), octree.n)"
        )
        done = subprocess.run([sys.executable, "-c", code, str(tree)], capture_output=True, text=True, check=True)
        lines = [line.split() for line in done.stdout.splitlines()]
        seconds, nodes, built = [float(line[0]) for line in lines], int(lines[0][1]), int(lines[0][2])
        rows.append(
            f"| {resolution}^3 | {nodes:,} | {built:,} | {spread(seconds, 3)} "
            f"| {statistics.median(seconds) / built * 1e6:.2f} |"
        )
    return rows


def machine() -> str:
    """The facts that a figure travels with."""
    cpuinfo = Path("/proc/cpuinfo")
    lines = cpuinfo.read_text().splitlines() if cpuinfo.exists() else []
    model = next((line.split(":")[1].strip() for line in lines if line.startswith("model name")), platform.processor())
    libraries = ", ".join(f"{name} {version(name)}" for name in ("numpy", "deflate", "nerfbake"))
    load = f"load average {os.getloadavg()[0]:.1f} before it began"
    return (
        f"{model}, {os.cpu_count()} cores, {load}; {platform.system()}; Python {platform.python_version()}, {libraries}"
    )


def main() -> None:
    """Measures everything and writes the report."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        report = [
            "# nerfbake svo, measured",
            "",
            f"{machine()}. {ROUNDS} rounds in turn after a warm-up; `python benchmarks/svo.py`.",
            "",
            "## Whole processes, against a Python process that np.loads every array of the same file",
            "",
            *tree_rows(folder),
            *child_rows(folder),
            "",
            "## Scaling: sample trees at their own resolution, 5 builds in one process",
            "",
            *scaling_rows(folder),
            "",
        ]
    RESULT.parent.mkdir(exist_ok=True)
    RESULT.write_text("\n".join(report))
    print(RESULT.read_text())


if __name__ == "__main__":
    main()
