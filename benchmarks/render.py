"""`nerfbake bench render` on the real chair at 256^3 and 128^3, in its five held-out views.

The aims are the time of a frame, and of a process that shows one picture.
"""

from __future__ import annotations

from benchmarks.aims import FIRST_PICTURE, FRAME, aims_table
from benchmarks.scenes import Scenes
from nerfbake import Cameras, load
from nerfbake.bench.progress import told
from nerfbake.bench.render import COLUMNS, chart_rendering, compare_rendering
from nerfbake.bench.report import Report, Table
from nerfbake.scene.n3tree import N3Tree

ROUNDS = 3

chart = chart_rendering


def reports(scenes: Scenes, *, rounds: int = ROUNDS) -> dict[str, list[Report]]:
    cameras = load(scenes.views / "transforms.json", Cameras)
    found = []
    for name in FRAME:
        report = compare_rendering(load(scenes.chairs / name, N3Tree), name, cameras, rounds=rounds, progress=told)
        found.append(report._replace(tables=[*report.tables, _aims(report, name)]))
    return {"render": found}


def _aims(report: Report, name: str) -> Table:
    frames, processes = report.tables
    frame = dict(zip(COLUMNS, frames.rows[0], strict=True))["ms a frame"].median
    return aims_table(
        [
            (f"{name}, PlenOctree, 400x400, nearest: ms a frame", FRAME[name], frame),
            (f"{name}: first picture of a process, s", FIRST_PICTURE, processes.rows[0][1].median),
        ]
    )
