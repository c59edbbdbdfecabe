"""Benchmark of `nerfbake fit` on NeRF-Synthetic (`bench fit`): quality, time, memory and size beside published figures.

The protocol is that of the papers: 800x800, white background, 100 training views, quality on all 200 test views. Each
fit is a process of its own, an item of a batch whose state survives interruptions. Its figures are those that
`nerfbake fit --json` prints, measured on the written file.
"""

from __future__ import annotations

from collections.abc import Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import Any, NamedTuple

from nerfbake import io, memory
from nerfbake.batch.report import Batch, Row
from nerfbake.batch.state import State
from nerfbake.bench.environment import environment
from nerfbake.bench.fit.published import PUBLISHED, SCENES
from nerfbake.bench.plot import Mark, scatter
from nerfbake.bench.report import Report, Table
from nerfbake.errors import InvalidFile, Problem, UsageError
from nerfbake.formats.wire.json import parse_object
from nerfbake.io.machine import machine
from nerfbake.jobs.batches import BatchOptions, Item, run_batch
from nerfbake.jobs.photographs import with_pictures
from nerfbake.jobs.steps import SILENT, Steps
from nerfbake.jobs.views import read_cameras

TRAINING, TEST = "transforms_train.json", "transforms_test.json"
OURS = "nerfbake"
MEAN = "mean"
FITS = ["scene", "preset", "PSNR dB", "SSIM", "s", "wall s", "cells", "MB", "peak MB", "test views", "schedule"]
BESIDE = "PSNR dB, beside published figures"
NOTES = [
    "Each fit: `nerfbake fit DATASET/SCENE SCENE.npz --preset PRESET --background white`, a process of its own.",
    "s: CPU seconds / 2, the time on two cores, without compilation of kernels and without evaluation. wall s: on "
    "this machine, with the same left out. peak: of the whole process; after an interruption, of its last process.",
    "PSNR and SSIM (11x11 Gaussian window, sigma 1.5): means over the figures of all test views at full size, rendered "
    "from the written file with 2x2 rays a pixel, before rounding to 8 bits.",
    "LPIPS is not reported: no package contains its weights. Those on PyPI (lpips 0.1.4, jaxlpips 1.2.0, lpips-nnx "
    "0.1.0) have at most the linear layers, and download AlexNet or VGG when they run.",
]
BESIDE_NOTES = [
    "minutes, MB: means over the scenes of the table. Published minutes are wall time on a graphics card, ours are CPU "
    "seconds / 120. Published MB are of models in each method's own format.",
    "Not equal: the hardware; 2x2 rays a pixel here, mostly one there; whether pictures are rounded to 8 bits before "
    "they are measured (0.005 dB at 35.3 dB). docs/sources.md names the sources.",
]


class SceneViews(NamedTuple):
    """What a scene offers: the numbers of its views with a picture, their size in pixels, and whether they have alpha.

    The differences from the papers' protocol are reported, not refused.
    """

    training: int
    test: int
    size: tuple[int, int]
    alpha: bool

    def __str__(self) -> str:
        alpha = "" if self.alpha else " without alpha"
        return f"{self.training} training views, {self.test} test views of {self.size[0]}x{self.size[1]}{alpha}"


PROTOCOL = SceneViews(training=100, test=200, size=(800, 800), alpha=True)


class PapersResult(NamedTuple):
    """The result of compare_papers(). report: None if a signal stopped the run; batch: the fits."""

    report: Report | None
    batch: Batch


def find_scenes(dataset: str, names: Sequence[str] = ()) -> dict[str, Path]:
    """Return the folders of the scenes by name: those of the papers in their order, then others.

    dataset: a folder of scenes as in NeRF-Synthetic, or the folder of one scene. names: the scenes to use; none: all.
    Raises InvalidFile if there are no scenes, UsageError for unknown names.
    """
    folder = Path(dataset)
    with io.blame(dataset):
        found = {path.name: path for path in folder.iterdir() if (path / TRAINING).is_file()}
    if (folder / TRAINING).is_file():
        found = {folder.resolve().name: folder}
    if not found:
        raise InvalidFile(f"has no scenes; allowed: folders with {TRAINING} and {TEST}", source=dataset)
    for name in names:
        if name not in found:
            near = get_close_matches(name, found, 1)
            hint = f", perhaps {near[0]}" if near else ""
            raise UsageError(f"{dataset} has no scene {name!r}{hint}; allowed: {', '.join(_ordered(found))}")
    return {name: found[name] for name in _ordered(names or found)}


def _ordered(names: Sequence[str] | dict[str, Path]) -> list[str]:
    known = [name for name in SCENES if name in names]
    return known + sorted(set(names) - set(known))


def inspect_scene(folder: Path) -> SceneViews:
    """Return what a scene offers. Raises InvalidFile if its test views or their pictures are missing."""
    if not (folder / TEST).is_file():
        raise InvalidFile(f"has no {TEST}; allowed: a scene with its test views", source=str(folder))
    splits = [str(folder / name) for name in (TRAINING, TEST)]
    (training, _), (test, files) = (with_pictures(SILENT, path, read_cameras(SILENT, path)) for path in splits)
    pixels = io.load_photograph(files[0])
    alpha = bool((pixels[..., 3] < 255).any())
    return SceneViews(len(training.cameras), len(test.cameras), (pixels.shape[1], pixels.shape[0]), alpha)


def compare_papers(
    dataset: str,
    *,
    state: str,
    scenes: Sequence[str] = (),
    presets: Sequence[str] = ("best",),
    published: bool = True,
    steps: Steps = SILENT,
) -> PapersResult:
    """Fit the scenes with each preset, and return the report.

    dataset, scenes  as in find_scenes()
    state            folder for the written files, the checkpoints and the record of what is done
    published        add the table with published figures

    A finished fit is not run again unless its pictures, its options or the version of nerfbake have changed; an
    unfinished one resumes from its checkpoint. A fit that fails has its error in the report. Raises NerfbakeError
    before the first fit if a scene cannot be used.
    """
    folders = find_scenes(dataset, scenes)
    offers = {name: inspect_scene(folder) for name, folder in folders.items()}
    fits = [(name, preset) for preset in presets for name in folders]
    limit = () if memory.left() == memory.DEFAULT else ("--max-memory", str(memory.left()))
    items = [
        _item(folders[name], (*_schedule(preset), *limit), Path(state) / f"{name}.{preset}") for name, preset in fits
    ]
    checkpoints = {item.argv: item.spare[0] for item in items}

    def clear(event: dict[str, Any]) -> None:
        """Remove the checkpoint of a fit that is done: it takes as much space as its file."""
        if event.get("status") == "done":
            io.remove_checkpoint(checkpoints[tuple(event["argv"])])

    batch = run_batch(items, state=state, run=BatchOptions(jobs=1), steps=steps, report=clear)
    if batch.stopped:
        return PapersResult(None, batch)
    known = State(state)
    rows = [_fit_row(known, row, *fit) for row, fit in zip(batch.rows, fits, strict=True)]
    for preset in presets if len(folders) > 1 else ():
        rows.append(_mean_row([row for row in rows if row[1] == preset], preset))
    tables = [Table("Fits, from the written file", FITS, rows)]
    notes = [
        f"{name} is not the papers' scene: {offer} ({PROTOCOL})." for name, offer in offers.items() if offer != PROTOCOL
    ]
    if published:
        source = "this run, other scenes" if notes else "this run"
        tables.append(_beside(rows, list(folders), presets, source))
        notes += BESIDE_NOTES
    head = {"dataset": Path(dataset).resolve().name, "rays a pixel": "2x2", **environment("numpy", "numba", "nerfbake")}
    others = [other for other in batch.machines if machine() not in other]
    if others:
        head["fits also ran on"] = "; ".join(others)
    return PapersResult(Report(f"NeRF-Synthetic: {', '.join(folders)}", head, tables, NOTES + notes), batch)


def _schedule(preset: str) -> tuple[str, ...]:
    return ("--preset", preset)


def _item(folder: Path, chosen: Sequence[str], place: Path) -> Item:
    """Return the fit of a scene with the chosen options, which writes files whose names start with `place`."""
    file, checkpoints = f"{place}.npz", f"{place}.checkpoints"
    argv = ("fit", str(folder), file, *chosen, "--background", "white", "--state", checkpoints, "--json", "-q")
    return Item(argv, writes=(file,), albums=(str(folder),), spare=(checkpoints,))


def _fit_row(state: State, row: Row, name: str, preset: str) -> list[Any]:
    if row.attempt is None or row.status != "done":
        why = row.attempt.error if row.attempt else row.status
        return [f"{name}: {why}", preset, *[None] * (len(FITS) - 2)]
    facts = _facts(state.folder / "log" / state.identify(row.item).id)
    last = facts["curve"][-1] if facts["curve"] else {"stage": None}
    whole = last["stage"] == facts["epochs"].count("/") + 1  # the last epoch may not have been measured
    figures = [f"{facts['psnr']:.2f}", f"{facts['ssim']:.4f}", facts["cpu_seconds"] / 2, facts["seconds"]]
    sizes = [last["cells"] if whole else None, facts["bytes"] / 1e6, row.attempt.peak / 1e6]
    return [name, preset, *figures, *sizes, len(facts["views"]), facts["epochs"]]


def _facts(log: Path) -> dict[str, Any]:
    """Return what a fit printed. Raises InvalidFile if the log was changed."""
    with io.blame(str(log)):
        facts = parse_object(log.read_bytes(), "the output of the fit")
        if missing := {"psnr", "ssim", "cpu_seconds", "seconds", "bytes", "epochs", "views", "curve"} - facts.keys():
            found = f"has no {sorted(missing)[0]}"
            raise InvalidFile(Problem("the output of the fit", found, "an unchanged log, or another `state`"))
        return facts


def _mean_row(rows: list[list[Any]], preset: str) -> list[Any]:
    """Return the means of the columns with figures; none if a fit failed."""
    means = [_mean([float(row[k]) if row[k] is not None else None for row in rows]) for k in range(2, len(FITS) - 2)]
    psnr, ssim, *others = means
    shown = [None if psnr is None else f"{psnr:.2f}", None if ssim is None else f"{ssim:.4f}"]
    return [MEAN, preset, *shown, *others, None, None]


def _mean(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return sum(known) / len(known) if known and len(known) == len(values) else None


def _beside(rows: list[list[Any]], scenes: list[str], presets: Sequence[str], source: str) -> Table:
    """Return PSNR by scene, mean minutes and mean MB of every method that has a figure for one of the scenes."""
    named = [scene for scene in scenes if scene in SCENES] or scenes
    cells: list[list[Any]] = []
    for method in PUBLISHED:
        psnr = [method.decibels(scene) for scene in named]
        if any(value is not None for value in psnr):
            others = [_mean([figure(scene) for scene in named]) for figure in (method.minutes, method.megabytes)]
            cells.append([method.name, *_psnr_cells(psnr), *others, method.hardware, method.source])
    here = f"two cores of {machine().rsplit(', ', 3)[0]}"
    for preset in presets:
        fits = {row[0]: dict(zip(FITS, row, strict=True)) for row in rows if row[1] == preset}
        psnr = [float(fits[scene]["PSNR dB"]) if scene in fits else None for scene in named]
        minutes = _mean([fits[scene]["s"] / 60 if scene in fits else None for scene in named])
        size = _mean([fits[scene]["MB"] if scene in fits else None for scene in named])
        cells.append([f"{OURS}, {preset}", *_psnr_cells(psnr), minutes, size, here, source])
    several = [MEAN] if len(named) > 1 else []
    return Table(BESIDE, ["method", *named, *several, "minutes", "MB", "hardware", "source"], cells)


def _psnr_cells(values: Sequence[float | None]) -> list[str | None]:
    """Return the cells of the scenes, and their mean if there are several."""
    shown = [*values, *([_mean(values)] if len(values) > 1 else [])]
    return [None if value is None else f"{value:.2f}" for value in shown]


def chart_papers(report: Report, suffix: str) -> bytes:
    """Plot PSNR against minutes, means over the scenes, with a colour for each kind of hardware.

    A method without minutes or without a figure for one of the scenes is left out. Raises UsageError without a table
    of published figures.
    """
    table = next((table for table in report.tables if table.title == BESIDE), None)
    if table is None:
        raise UsageError("the chart shows published figures; allowed: `table=published`")
    marks = []
    for row in table.rows:
        cells = dict(zip(table.columns, row, strict=True))
        psnr = cells.get(MEAN, row[1])
        if psnr is not None and cells["minutes"] is not None:
            marks.append(
                Mark(cells["method"], cells["minutes"], float(psnr), f"{cells['hardware']} ({cells['source']})")
            )
    axes = {"x": "minutes of training", "y": "PSNR dB on the test views", "logarithmic": ""}
    return scatter(marks, title=report.title, suffix=suffix, **axes)
