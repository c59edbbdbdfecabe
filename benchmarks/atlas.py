"""`nerfbake bench atlas` on nerf2mesh's real texture, and what `nerfbake atlas` takes as a whole, cold and warm.

Cold: the first run after installing, which compiles the kernels; warm: every later one.
"""

from __future__ import annotations

import sys
import tempfile
from functools import partial
from typing import Any

from benchmarks.scenes import Scenes
from nerfbake.bench.atlas.comparison import chart_atlases, compare_atlases
from nerfbake.bench.measure import Statistics, in_turn
from nerfbake.bench.process import measure_process
from nerfbake.bench.progress import told
from nerfbake.bench.report import Report, Table

ROUNDS = 3  # of the whole command; its steps are measured once
COLD, *WARM = 64, 64, 256, 2048  # clusters

chart = chart_atlases


def reports(scenes: Scenes, *, rounds: int = ROUNDS) -> dict[str, list[Report]]:
    report = compare_atlases(str(scenes.stage1), rounds=1, progress=told)
    title = "`nerfbake atlas` as a whole: import, read, bake, measure, write; median [min..max]"
    whole = Table(title, ["clusters", "s"], _whole_rows(scenes, rounds))
    return {"atlas": [report._replace(tables=[*report.tables, whole])]}


def _whole_rows(scenes: Scenes, rounds: int) -> list[list[Any]]:
    # Warm ones first: their rounds also compile Python's modules, as installing does.
    with tempfile.TemporaryDirectory() as kernels, told("nerfbake atlas as a whole"):
        warm = in_turn(*(partial(_seconds, scenes, clusters, kernels) for clusters in WARM), rounds=rounds)
    with tempfile.TemporaryDirectory() as kernels, told("nerfbake atlas as a whole, cold"):
        cold = _seconds(scenes, COLD, kernels)
    rows = [[f"{clusters}, warm", Statistics.of(seconds)] for clusters, seconds in zip(WARM, warm, strict=True)]
    return [[f"{COLD}, cold", cold], *rows]


def _seconds(scenes: Scenes, clusters: int, kernels: str) -> float:
    """Of the whole command, errors measured and all files written; kernels: the folder of compiled ones."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "nerfbake", "atlas", str(scenes.stage1), f"{folder}/out", "-q"]
        environment = {"NUMBA_CACHE_DIR": kernels}
        return measure_process(*command, "--clusters", str(clusters), environment=environment).seconds
