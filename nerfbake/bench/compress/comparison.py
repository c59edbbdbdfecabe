"""The rate-distortion curve of `nerfbake compress` on one's own scene and machine, beside what others do with leaves.

Each row is a process of its own, which packs the octree, and looks at what comes back when the clock has stopped.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, cast

import numpy as np

import nerfbake
from nerfbake import io
from nerfbake.bench.compress.contenders import contenders
from nerfbake.bench.environment import environment
from nerfbake.bench.measure import Result, Statistics, Work, measure, seconds_of
from nerfbake.bench.plot import Mark, scatter
from nerfbake.bench.progress import Progress
from nerfbake.bench.report import Report, Table
from nerfbake.kernels.maths.elementary import log
from nerfbake.memory import memory_limit
from nerfbake.stages._coefficients import visible_leaves
from nerfbake.stages._loss import measuring_judge, predicting_judge

SOURCE_PSNR = 35.0  # dB, as `nerfbake compress` has it
LOSSES = (0.05, 0.1, 0.2, 0.4, 0.8)  # dB
COLUMNS = ["file", "MB", "predicted dB", "measured dB", "PSNR to the scene", "encode s", "decode s", "peak MB"]
_GROUP = {"range": "svoq", "deflate": "svoq, deflate"}
_LEAST = 1e-3  # dB, that a chart shows
_LN_10 = 2.302585092994046
NOTES = [
    f"predicted: the loss of PSNR for a source of {SOURCE_PSNR:g} dB, from views all around; measured: of the mean "
    "PSNR against the photographs.",
    "svoq: `nerfbake compress --max-loss`, its search included; the others pack the leaves, without inner nodes.",
    "peak: memory that encoding added to its process. decode: of .svoq, from the file to the octree.",
]


def compare_compression(
    octree: nerfbake.SparseVoxelOctree,
    name: str,
    *,
    cameras: str | None = None,
    truth: str | None = None,
    rounds: int,
    progress: Progress,
) -> Report:
    """Packs the octree in every way, and reports.

    cameras, truth: a capture, and the folder with a photograph NAME.png for each of its cameras, which the loss is
    measured against; or None.
    """
    rows = [(f"svoq {coding}, {loss:g} dB", coding, loss) for coding in _GROUP for loss in LOSSES]
    cells = []
    with TemporaryDirectory(prefix="nerfbake-bench-") as folder:
        path = str(Path(folder) / "scene.svo.npz")
        with progress("writing the octree"):
            io.save(path, octree)
        seen = {"path": path, "cameras": cameras, "truth": truth}
        for label, coding, loss in rows:
            work = partial(measure, compressing, coding=coding, loss=loss, **seen)
            cells.append(_cells(label, [_told(progress, label, work) for _ in range(rounds)]))
        for label in contenders():
            work = partial(measure, packing, name=label, **seen)
            cells.append(_cells(label, [_told(progress, label, work) for _ in range(rounds)]))
    head = {"scene": f"{name}: {octree}", "rounds": str(rounds), **environment("numpy", "numba", "scikit-learn")}
    return Report(f"Compression: {name}", head, [Table("Compression", COLUMNS, cells)], NOTES)


def chart_compression(report: Report, suffix: str) -> bytes:
    """Loss against bytes, a point for each row that lost enough to be seen."""
    rows = [dict(zip(COLUMNS, row, strict=True)) for row in report.tables[0].rows]
    groups = {label: group for label, (group, _) in contenders().items()}
    marks = []
    for row in rows:
        loss = row["predicted dB"] if row["measured dB"] is None else row["measured dB"]
        if loss is not None and loss > _LEAST:
            group = groups.get(row["file"]) or _GROUP[row["file"].split()[1].rstrip(",")]
            marks.append(Mark(row["file"].removeprefix("svoq "), row["MB"], loss, group))
    return scatter(marks, title=report.title, x="file, MB", y="loss, dB", suffix=suffix)


def compressing(path: str, coding: str, loss: float, cameras: str | None, truth: str | None) -> Work:
    """The work of compressing the octree of a file to so small a loss, as predicted; in a process of its own."""
    octree, folder = _octree(path), TemporaryDirectory(prefix="nerfbake-bench-")
    target = str(Path(folder.name) / "scene.svoq")
    size = partial(io.format_for(target, "QuantisedOctree").load_packed_module().coded_size, coding=coding)
    small = nerfbake.build_octree(nerfbake.sample_n3tree(resolution=8))

    def compressed(scene: nerfbake.SparseVoxelOctree, goal: dict[str, float]) -> int:
        found = nerfbake.compress_octree(scene, coded_size=size, **goal)  # type: ignore[arg-type]
        return io.save(target, found.quantised, coding=coding, force=True)

    compressed(small, {"step": 0.2})  # compiled code is read from the disk before the clock runs
    io.load(target)

    def check(written: int) -> dict[str, Any]:
        with folder, memory_limit(1 << 46):
            back, seconds = seconds_of(lambda: io.load(target, nerfbake.SparseVoxelOctree))
        return {"size": written, "decode": seconds, **_costs(octree, nerfbake.build_field(back), cameras, truth)}

    return Work(lambda: compressed(octree, {"max_loss": loss}), check)


def packing(path: str, name: str, cameras: str | None, truth: str | None) -> Work:
    """The work of packing the leaves of an octree as one of contenders() does; in a process of its own."""
    octree = _octree(path)
    field, (_, pack) = nerfbake.build_field(octree), contenders()[name]
    values = np.asarray(octree.node_data)[visible_leaves(octree)].astype(np.float32)
    masks = np.packbits(octree.node_children != 0, axis=1, bitorder="little").tobytes()

    def check(packed: Any) -> dict[str, Any]:
        return {"size": len(packed.data), **_costs(octree, replace(field, values=packed.values), cameras, truth)}

    return Work(lambda: pack(masks, values), check)


def _octree(path: str) -> nerfbake.SparseVoxelOctree:
    with memory_limit(1 << 46):
        return io.load(path, nerfbake.SparseVoxelOctree)


def _costs(
    octree: nerfbake.SparseVoxelOctree, field: nerfbake.RadianceField, cameras: str | None, truth: str | None
) -> dict[str, Any]:
    own, measured = nerfbake.build_field(octree), None
    cost = predicting_judge(own, source_psnr=SOURCE_PSNR).cost(field)
    psnr = -10 / _LN_10 * float(log(cost.error)) if cost.error > 0 else None
    if cameras and truth:
        views = io.load(cameras, nerfbake.Cameras)
        seen = io.Truth(truth, views.names, nerfbake.Image)
        held_out = nerfbake.HeldOut.of_images(views.fitting(seen), seen)
        measured = measuring_judge(own, held_out).cost(field).loss
    return {"predicted": cost.loss, "measured": measured, "psnr": psnr}


def _told(progress: Progress, label: str, work: Any) -> Result:
    with progress(label):
        return cast(Result, work())


def _cells(label: str, found: list[Result]) -> list[Any]:
    if error := next((result.error for result in found if result.error), ""):
        return [f"{label}: {error}", *[None] * (len(COLUMNS) - 1)]
    facts = found[0].facts
    times = [Statistics.of([result.seconds for result in found]), None]
    if "decode" in facts:
        times[1] = Statistics.of([result.facts["decode"] for result in found])
    peak = max(result.peak for result in found) / 1e6
    return [label, facts["size"] / 1e6, facts["predicted"], facts["measured"], facts["psnr"], *times, peak]
