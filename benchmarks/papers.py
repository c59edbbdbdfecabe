"""Benchmark of `nerfbake fit` on the papers' protocol: the NeRF-Synthetic chair at 800x800.

Each preset is fitted to the 100 training views and measured on all 200 test views, beside the published figures of
other methods (`nerfbake bench fit`). The aims are time, PSNR and file size of each preset, and the memory of the fits.
The chart has PSNR against minutes.
"""

from __future__ import annotations

from benchmarks.aims import PAPERS, PAPERS_MEMORY, Aim, aims_table
from benchmarks.processes import announced
from benchmarks.scenes import Scenes
from nerfbake.bench.fit.comparison import FITS, chart_papers, compare_papers
from nerfbake.bench.report import Report, Table
from nerfbake.errors import NerfbakeError

SCENE = "chair"

chart = chart_papers


def reports(scenes: Scenes, *, rounds: int = 1) -> dict[str, list[Report]]:
    if rounds != 1:
        raise ValueError("a fit has the same bytes in every round; allowed: rounds=1")
    with announced(f"fitting {SCENE}: {', '.join(PAPERS)}"):
        state = str(scenes.folder / "papers")
        report, batch = compare_papers(str(scenes.nerf_synthetic), state=state, scenes=(SCENE,), presets=tuple(PAPERS))
    if report is None:
        raise NerfbakeError(batch.summary)
    fits, *others = report.tables
    return {"papers": [report._replace(tables=[fits, _aims(fits), *others])]}


def _aims(fits: Table) -> Table:
    rows: list[tuple[str, Aim, float | None]] = []
    for row in fits.rows:
        fit = dict(zip(FITS, row, strict=True))
        aims = {**PAPERS[fit["preset"]], "peak MB": PAPERS_MEMORY}
        figures = {what: None if fit[what] is None else float(fit[what]) for what in aims}
        rows += [(f"{fit['preset']}: {what}", aim, figures[what]) for what, aim in aims.items()]
    return aims_table(rows)
