"""`nerfbake bench access` on the real chair, with the rays of its 25 test views.

    python benchmarks/access.py         rewrites benchmarks/results/access.{md,svg}

Then it holds the figures to what the project aims for: on-surface reads in at most 0.6 of NanoVDB's time. The head says
how busy the machine was. Needs the real chair beside the project.
"""

from __future__ import annotations

import os
from pathlib import Path

from nerfbake import load
from nerfbake.bench.access import RESOLUTIONS, chart, compare
from nerfbake.bench.progress import told
from nerfbake.bench.report import Report, Table, markdown
from nerfbake.scene.camera import Cameras
from nerfbake.scene.n3tree import N3Tree

HERE = Path(__file__).parent
DATA = Path(os.environ.get("NERFBAKE_DATA", HERE.parents[1] / "shared" / "data"))
CHAIR = DATA / "plenoctree" / "chair" / "chair_sh9.npz"
VIEWS = DATA / "nerf_synthetic" / "chair" / "transforms_test.json"
RESULT = HERE / "results" / "access.md"
ROUNDS = 5
AIM = 0.6


def aims(report: Report) -> Table:
    """What is aimed for and what was measured."""
    rows = [dict(zip(report.tables[0].columns, row, strict=True)) for row in report.tables[0].rows]
    ratios = [(row["R"], row["surface x NanoVDB"]) for row in rows if row["structure"] == "VDB"]
    cells = [
        [f"VDB at {R}^3: surface, x NanoVDB", f"at most {AIM}", ratio, ratio is not None and ratio <= AIM]
        for R, ratio in ratios
    ]
    return Table("Aims", ["aim", "allowed", "measured", "holds"], cells)


def main() -> None:
    """Writes benchmarks/results/access.*."""
    before = os.getloadavg()[0]
    report = compare(
        load(CHAIR, N3Tree),
        CHAIR.name,
        resolutions=RESOLUTIONS,
        rounds=ROUNDS,
        cameras=load(VIEWS, Cameras).cameras,
        progress=told,
    )
    load_average = f"{before:.2f} before, {os.getloadavg()[0]:.2f} after, of which 1 is the benchmark's"
    report = report._replace(head={**report.head, "load average": load_average})
    reads, *others = report.tables
    RESULT.write_text(markdown(report._replace(tables=[reads, aims(report), *others])))
    RESULT.with_suffix(".svg").write_bytes(chart(report, ".svg"))


if __name__ == "__main__":
    main()
