"""`nerfbake bench atlas` on nerf2mesh's real texture, and the time of the whole command `nerfbake atlas`.

The command is measured cold (the first run after installation, which compiles the kernels) and warm (all later runs).
"""

from __future__ import annotations

import sys
import tempfile
from functools import partial
from typing import Any

from benchmarks.processes import announced, in_turn, measure_process
from benchmarks.scenes import Scenes
from nerfbake.bench.atlas import chart_atlases, compare_atlases
from nerfbake.bench.measure import Statistics
from nerfbake.bench.report import Report, Table

ROUNDS = 3  # rounds of the whole command; its steps are measured once
COLD, *WARM = 64, 64, 256, 2048  # clusters

chart = chart_atlases


def reports(scenes: Scenes, *, rounds: int = ROUNDS) -> dict[str, list[Report]]:
    report = compare_atlases(str(scenes.stage1), rounds=1, progress=announced)
    title = "`nerfbake atlas` as a whole: import, read, bake, measure, write; median [min..max]"
    whole = Table(title, ["clusters", "s"], _whole_rows(scenes, rounds))
    return {"atlas": [report._replace(tables=[*report.tables, whole])]}


def _whole_rows(scenes: Scenes, rounds: int) -> list[list[Any]]:
    # Warm runs come first: they also compile the Python modules, which are compiled in an installation.
    with tempfile.TemporaryDirectory() as kernels, announced("nerfbake atlas as a whole"):
        warm = in_turn(*(partial(_seconds, scenes, clusters, kernels) for clusters in WARM), rounds=rounds)
    with tempfile.TemporaryDirectory() as kernels, announced("nerfbake atlas as a whole, cold"):
        cold = _seconds(scenes, COLD, kernels)
    rows = [[f"{clusters}, warm", Statistics.of(seconds)] for clusters, seconds in zip(WARM, warm, strict=True)]
    return [[f"{COLD}, cold", cold], *rows]


def _seconds(scenes: Scenes, clusters: int, kernels: str) -> float:
    """The seconds of the whole command, with errors measured and all files written.

    kernels: the folder of compiled kernels.
    """
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "nerfbake", "atlas", str(scenes.stage1), f"{folder}/out", "-q"]
        environment = {"NUMBA_CACHE_DIR": kernels}
        return measure_process(*command, "--clusters", str(clusters), environment=environment).seconds
