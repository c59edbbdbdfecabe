"""Benchmark of compression: rate-distortion curves of `nerfbake compress` and of other methods, on any scene.

Each row is measured in a separate process, which packs the octree, and decodes and checks it after the clock has
stopped. The other methods pack the same topology, a byte a mask, and the values of the leaves:

    float16      all values, by a general compressor
    palette      K vectors of all coefficients (K-means), an index for each leaf, density as float16
    median cut   for each basis function a table of colours (red, green, blue) and an index for each leaf, density as
                 float16: the quantisation of PlenOctrees, as stored in its N3Tree dialect (docs/formats/n3tree.md)

Palettes and tables are deflated. No method stores the values of inner nodes, which readers can recompute.
"""

from __future__ import annotations

import lzma
import zlib
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple, cast

import numpy as np
import numpy.typing as npt

from nerfbake import io
from nerfbake.bench.environment import environment
from nerfbake.bench.measure import Progress, Result, Statistics, Work, measure, seconds_of
from nerfbake.bench.plot import Mark, scatter
from nerfbake.bench.report import Report, Table
from nerfbake.kernels.arrays import Ints, Singles
from nerfbake.kernels.maths.elementary import log
from nerfbake.memory import memory_limit
from nerfbake.scene.camera import Cameras
from nerfbake.scene.held_out import HeldOut
from nerfbake.scene.image import Image
from nerfbake.scene.octree import SparseVoxelOctree
from nerfbake.scene.radiance_field import RadianceField
from nerfbake.stages.coefficients import visible_leaves
from nerfbake.stages.loss import SOURCE_PSNR, measuring_judge, predicting_judge
from nerfbake.stages.n3tree_to_octree import build_octree
from nerfbake.stages.octree_to_compression import compress_octree
from nerfbake.stages.scene_to_field import build_field
from nerfbake.stages.shapes_to_n3tree import sample_n3tree

_SAMPLE = 100_000  # leaves from which a palette is computed
_BATCH = 1 << 14


class Packed(NamedTuple):
    """data: the packed bytes; values (m, D) float32: the values of the leaves after unpacking."""

    data: bytes
    values: Singles


Contender = Callable[[bytes, Singles], Packed]  # arguments: topology, values of the leaves with density last


def contenders() -> dict[str, tuple[str, Contender]]:
    """Return the other methods by name: the group in a chart, and the function that packs."""
    found: dict[str, tuple[str, Contender]] = {
        "float16, deflate": ("float16", _whole(_deflated)),
        "float16, zstd": ("float16", _whole(_zstd)),
        "float16, xz": ("float16", _whole(lzma.compress)),
    }
    for K in (256, 1024, 4096):
        found[f"palette of {K:,}"] = ("palette", _palette(K))
    for bits in (8, 12, 16):
        found[f"median cut to {1 << bits:,}"] = ("median cut", _median_cut(bits))
    return found


def _deflated(data: bytes) -> bytes:
    return zlib.compress(data, 9)


def _zstd(data: bytes) -> bytes:
    import zstandard

    return zstandard.ZstdCompressor(19).compress(data)


def _whole(pack: Callable[[bytes], bytes]) -> Contender:
    def packed(topology: bytes, values: Singles) -> Packed:
        half = _half(values)
        return Packed(pack(topology + half.tobytes()), half.astype(np.float32))

    return packed


def _palette(K: int) -> Contender:
    def packed(topology: bytes, values: Singles) -> Packed:
        from sklearn.cluster import MiniBatchKMeans

        colours = values[:, :-1]
        some = colours[:: -(-len(colours) // _SAMPLE)]
        means = MiniBatchKMeans(min(K, len(some)), n_init=1, random_state=0, batch_size=_BATCH).fit(some)
        numbers = means.predict(colours).astype(np.uint16 if K > 256 else np.uint8)
        return _from_tables(topology, [_half(means.cluster_centers_)], [numbers], values)

    return packed


def _median_cut(bits: int) -> Contender:
    def packed(topology: bytes, values: Singles) -> Packed:
        m, B = len(values), values.shape[1] // 3
        colours = values[:, :-1].reshape(m, 3, B)
        tables, numbers = [], []
        for function in range(B):
            table, number = median_cut(colours[:, :, function], bits)
            tables.append(_half(table))
            numbers.append(number.astype(np.uint16 if bits > 8 else np.uint8))
        return _from_tables(topology, tables, numbers, values)

    return packed


def median_cut(points: Singles, bits: int) -> tuple[Singles, Ints]:
    """Group points (m, 3) into boxes; return the means of the boxes (2^bits, 3) and the box of each point (m,).

    All points are one box at first. `bits` times, every box is split at the median of its longest axis.
    Source: Heckbert, "Color image quantization for frame buffer display", 1982.
    """
    box = np.zeros(len(points), np.int64)
    for depth in range(bits):
        low, high = (np.full((1 << depth, 3), sign * np.inf, np.float32) for sign in (1, -1))
        np.minimum.at(low, box, points)
        np.maximum.at(high, box, points)
        with np.errstate(invalid="ignore"):
            axis = np.argmax(np.nan_to_num(high - low), axis=1)
        order = np.lexsort((points[np.arange(len(points)), axis[box]], box))
        counts = np.bincount(box, minlength=1 << depth)
        rank = np.empty(len(points), np.int64)
        rank[order] = np.arange(len(points)) - np.repeat(np.cumsum(counts) - counts, counts)
        box = 2 * box + (2 * rank >= counts[box])
    counts = np.bincount(box, minlength=1 << bits)
    sums = np.stack([np.bincount(box, points[:, c], 1 << bits) for c in range(3)], axis=1)
    return (sums / np.maximum(counts, 1)[:, None]).astype(np.float32), box


def _from_tables(topology: bytes, tables: list[Any], numbers: list[Any], values: Singles) -> Packed:
    """Pack one table of all coefficients, or a table of three coefficients for each basis function."""
    sigma, back = _half(values[:, -1]), np.empty_like(values)
    B = values.shape[1] // 3
    for function, (table, number) in enumerate(zip(tables, numbers, strict=True)):
        back[:, slice(0, -1) if len(tables) == 1 and B > 1 else slice(function, -1, B)] = table[number]
    back[:, -1] = sigma
    pieces = [topology, *(array.tobytes() for array in (*tables, *numbers, sigma))]
    return Packed(_deflated(b"".join(pieces)), back)


def _half(values: npt.NDArray[Any]) -> npt.NDArray[np.float16]:
    found: npt.NDArray[np.float16] = np.clip(values, -65504, 65504).astype(np.float16)
    return found


LOSSES = (0.05, 0.1, 0.2, 0.4, 0.8)  # dB
COLUMNS = ["file", "MB", "predicted dB", "measured dB", "PSNR to the scene", "encode s", "decode s", "peak MB"]
_GROUP = {"range": "svoq", "deflate": "svoq, deflate"}
_LEAST = 1e-3  # dB, the smallest loss in a chart
_LN_10 = 2.302585092994046
NOTES = [
    f"predicted: at most this loss of PSNR for a source of {SOURCE_PSNR:g} dB, from views all around the scene; "
    "measured: loss of the mean PSNR against the photographs.",
    "svoq: `nerfbake compress --max-loss`, including its search. The other methods pack the leaves only, without inner "
    "nodes.",
    "peak: memory that encoding added to its process. decode: .svoq only, from the file to the octree.",
]


def compare_compression(
    octree: SparseVoxelOctree,
    name: str,
    *,
    cameras: str | None = None,
    truth: str | None = None,
    rounds: int,
    progress: Progress,
) -> Report:
    """Pack the octree with every method, and return the report.

    cameras, truth: a capture, and the folder with a photograph NAME.png for each of its cameras, to measure the loss;
    or None.
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
            cells.append(_cells(label, [_with_progress(progress, label, work) for _ in range(rounds)]))
        for label in contenders():
            work = partial(measure, packing, name=label, **seen)
            cells.append(_cells(label, [_with_progress(progress, label, work) for _ in range(rounds)]))
    head = {"scene": f"{name}: {octree}", "rounds": str(rounds), **environment("numpy", "numba", "scikit-learn")}
    return Report(f"Compression: {name}", head, [Table("Compression", COLUMNS, cells)], NOTES)


def chart_compression(report: Report, suffix: str) -> bytes:
    """Plot loss against bytes, with a point for each row whose loss exceeds _LEAST."""
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
    """The work of compressing a file's octree with at most this predicted loss; called in a child process."""
    octree, folder = _octree(path), TemporaryDirectory(prefix="nerfbake-bench-")
    target = str(Path(folder.name) / "scene.svoq")
    size = partial(io.format_for(target, "QuantisedOctree").load_packed_module().coded_size, coding=coding)
    small = build_octree(sample_n3tree(resolution=8))

    def compressed(scene: SparseVoxelOctree, goal: dict[str, float]) -> int:
        found = compress_octree(scene, coded_size=size, **goal)  # type: ignore[arg-type]
        return io.save(target, found.quantised, coding=coding, force=True)

    compressed(small, {"step": 0.2})  # loads compiled code before the clock starts
    io.load(target)

    def check(written: int) -> dict[str, Any]:
        with folder, memory_limit(1 << 46):
            back, seconds = seconds_of(lambda: io.load(target, SparseVoxelOctree))
        return {"size": written, "decode": seconds, **_costs(octree, build_field(back), cameras, truth)}

    return Work(lambda: compressed(octree, {"max_loss": loss}), check)


def packing(path: str, name: str, cameras: str | None, truth: str | None) -> Work:
    """The work of packing an octree's leaves with one of contenders(); called in a child process."""
    octree = _octree(path)
    field, (_, pack) = build_field(octree), contenders()[name]
    values = np.asarray(octree.node_data)[visible_leaves(octree)].astype(np.float32)
    masks = np.packbits(octree.node_children != 0, axis=1, bitorder="little").tobytes()

    def check(packed: Any) -> dict[str, Any]:
        return {"size": len(packed.data), **_costs(octree, replace(field, values=packed.values), cameras, truth)}

    return Work(lambda: pack(masks, values), check)


def _octree(path: str) -> SparseVoxelOctree:
    with memory_limit(1 << 46):
        return io.load(path, SparseVoxelOctree)


def _costs(octree: SparseVoxelOctree, field: RadianceField, cameras: str | None, truth: str | None) -> dict[str, Any]:
    own, measured = build_field(octree), None
    cost = predicting_judge(own).cost(field)
    psnr = -10 / _LN_10 * float(log(cost.error)) if cost.error > 0 else None
    if cameras and truth:
        views = io.load(cameras, Cameras)
        seen = io.Truth(truth, views.names, Image)
        held_out = HeldOut.of_images(views.fitting(seen), seen)
        measured = measuring_judge(own, held_out).cost(field).loss
    return {"predicted": cost.loss, "measured": measured, "psnr": psnr}


def _with_progress(progress: Progress, label: str, work: Any) -> Result:
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
