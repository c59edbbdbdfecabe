"""The table of benchmarks. Each entry is a module of this package with its files in benchmarks/results.

A module describes its comparison in its docstring. It has

    reports(scenes, *, rounds) -> {stem: reports}     the default of rounds is that of the published figures; also
                                                      bytes, the contents of a file that is no report
    chart(report, suffix) -> bytes                    if one of its files is a chart
"""

from __future__ import annotations

import os
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

from benchmarks.scenes import Scenes
from nerfbake.bench.report import WRITERS, Report, document

RESULTS = Path(__file__).parent / "results"


class Benchmark(NamedTuple):
    """A module of this package and its files. The extension of a report is its kind; a chart shows the first report."""

    name: str
    files: tuple[str, ...]


SUITE = (
    Benchmark("svo", ("svo.md",)),
    Benchmark("formats", ("formats.md", "formats.csv", "formats.json", "formats.svg")),
    Benchmark("wires", ("wires.md",)),
    Benchmark("vdb", ("vdb.md",)),
    Benchmark("access", ("access.md", "access.svg", "access_800.md")),
    Benchmark("render", ("render.md", "render.svg")),
    Benchmark("outputs", ("outputs.md",)),
    Benchmark("batch", ("batch.md",)),
    Benchmark("fit", ("fit.md", "fit.svg")),
    Benchmark("cores", ("cores.md",)),
    Benchmark("papers", ("papers.md", "papers.svg")),
    Benchmark("captures", ("captures.md", "captures.svg", "captures_views.png")),
    Benchmark("mesh", ("mesh.md", "mesh.svg")),
    Benchmark("inputs", ("inputs.md",)),
    Benchmark("splats", ("splats.md",)),
    Benchmark("atlas", ("atlas.md", "atlas.png")),
    Benchmark("view", ("view.md",)),
    Benchmark("compress", ("compress.md", "compress.csv", "compress.json", "compress.svg", "compress_promises.md")),
    Benchmark("gpu", ("gpu.md", "gpu.json")),
)

# The first shows photographs that are not this project's. The others wait for a machine with a graphics card.
UNPUBLISHED = {"captures_views.png", "gpu.md", "gpu.json"}


def run(benchmark: Benchmark, scenes: Scenes, **options: Any) -> dict[str, bytes]:
    """Return the contents of the benchmark's files by name. Raises NerfbakeError if a scene or a program is missing."""
    module = import_module(f"benchmarks.{benchmark.name}")
    before = os.getloadavg()[0]
    found: dict[str, list[Report] | bytes] = module.reports(scenes, **options)
    load_average = f"{before:.2f} before, {os.getloadavg()[0]:.2f} after"
    made = {"load average": load_average, "made by": f"`python -m benchmarks {benchmark.name}`"}
    files = {}
    for name in benchmark.files:
        stem, _, kind = name.partition(".")
        content = found[stem]
        if isinstance(content, bytes):
            files[name] = content
            continue
        reports = [report._replace(head={**report.head, **made}) for report in content]
        if kind in WRITERS:
            files[name] = document(reports, kind).encode()
        else:
            files[name] = module.chart(reports[0], f".{kind}")
    return files
