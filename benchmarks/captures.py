"""Benchmark of captures as people take them: photographs of a phone, with scenery, with masks, or without cameras.

Each fit is a whole process. Its seconds are half of its CPU seconds without compilation and evaluation, that is, the
time on two cores. Every eighth view is held out, and measured with 2x2 rays a pixel. Photographs are shrunk by
averaging squares of pixels. One capture is also fitted from its photographs alone: their poses are found and compared
with the capture's COLMAP model, and the scene is written as a page. The room is that of `nerfbake sample capture
--room`, whose depths are known. A capture or a program that is missing keeps its row and says so.

captures_views.png has a line for each fit: photograph and rendering of its median view, then of its worst view.
"""

from __future__ import annotations

import json
import shutil
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from io import BytesIO
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from PIL import Image as Pillow

from benchmarks.aims import CAPTURE_LEAVES, CAPTURE_MEMORY, CAPTURES, PHOTOGRAPHS_TO_PAGE, POSES, Aim, aims_table
from benchmarks.fit import CURVE, OVER_TIME, Fit, chart_fits, curve_rows
from benchmarks.processes import announced, measure_process
from benchmarks.scenes import Scenes
from nerfbake import Cameras, N3Tree, RadianceField, Views, build_field, load, render_field, render_room
from nerfbake.bench.environment import environment
from nerfbake.bench.measure import Result
from nerfbake.bench.report import Report, Table
from nerfbake.errors import NerfbakeError
from nerfbake.jobs.files import Source
from nerfbake.jobs.photographs import PhotographOptions, read_photographs
from nerfbake.jobs.samples import write_sample_capture
from nerfbake.jobs.steps import SILENT

Points = npt.NDArray[np.float64]
Pixels = npt.NDArray[np.uint8]


class Row(NamedTuple):
    """A fit. capture: a folder of the captures, or ROOM. shrink: edge in pixels of the squares that are averaged."""

    name: str
    capture: str
    shrink: int
    options: tuple[str, ...]


ROOM, ROOM_FRAMES, ROOM_EDGE = "room", 24, 200
ROWS = (
    *(Row(f"plush 504x378, {preset}", "plush", 2, ("--preset", preset)) for preset in ("fast", "balanced", "best")),
    Row("mug 432x432, masks, fast", "mug", 2, ("--preset", "fast")),
    Row(f"room {ROOM_EDGE}x{ROOM_EDGE}, fast", ROOM, 1, ("--preset", "fast")),
)
ALONE = Row("plush 1008x756, photographs alone, fast", "plush", 1, ("--preset", "fast"))
SAMPLES = 2  # rays along an edge of a pixel
SHOWN, GAP = 320, 4  # pixels in captures_views.png: the width of a picture, and the distance between two

FITS = ["fit", "s", "peak MB", "leaves", "PSNR dB", "worst view", "median view", "corrected", "MB"]
DEPTHS = ["view", "PSNR dB", "median error %", "within 5 %", "nearer than half"]
STEPS = ["nerfbake ...", "s", "wall s", "peak MB"]
PLACES = ["pictures", "registered", "points", "reprojection error px", "mean error %", "largest error %"]
NOTES = [
    "Fits: s: CPU seconds / 2, without compilation of kernels and without evaluation. peak: of the whole process. "
    "PSNR: in dB, from the written file with the reference renderer: mean over the held-out views, and of the worst "
    "and the median one. corrected: the mean after a gain a channel for each view, which removes exposures.",
    "Photographs alone: whole processes, with evaluation; s: CPU seconds / 2. error: distance between the positions of "
    "the found and the given cameras after a similarity, in % of the largest distance of a given one from their mean.",
    "Depths of the room: against the exact ones. within 5 %, nearer than half: shares of the pixels; the latter have "
    "something in front of what is there.",
    "captures_views.png: a line for each fit: photograph and rendering of the median view, then of the worst view.",
]

chart = chart_fits


class Fitted(NamedTuple):
    """A fit, its process, the held-out views with their PSNR in dB, and the scene as it was written."""

    fit: Fit
    run: Result
    views: Views
    decibels: list[float]
    scene: RadianceField


@dataclass
class Collected:
    """Rows of the tables, figures by the label of their aim, and lines of pictures."""

    fits: list[list[Any]] = field(default_factory=list)
    depths: list[list[Any]] = field(default_factory=list)
    curves: list[list[Any]] = field(default_factory=list)
    steps: list[list[Any]] = field(default_factory=list)
    places: list[list[Any]] = field(default_factory=list)
    figures: dict[str, float] = field(default_factory=dict)
    lines: list[list[Pixels]] = field(default_factory=list)

    def add(self, row: Row, fit: Callable[[], Fitted]) -> Fitted:
        """Add what a fit gives to all tables, or its error to the table of fits, and raise it."""
        try:
            fitted = fit()
        except NerfbakeError as error:
            self.fits.append(_missing(row.name, error, FITS))
            raise
        facts, decibels = fitted.fit.facts, fitted.decibels
        seconds, peak, leaves = facts["cpu_seconds"] / 2, fitted.fit.peak / 1e6, facts["curve"][-1]["cells"]
        shown = [facts["psnr"], min(decibels), float(np.median(decibels)), facts["corrected"]]
        told = [f"{each:.2f}" for each in shown]
        self.fits.append([row.name, seconds, peak, leaves, *told, facts["bytes"] / 1e6])
        self.figures |= {f"{row.name}: s": seconds, f"{row.name}: PSNR dB": facts["psnr"]}
        for most, figure in (("largest peak MB", peak), ("most leaves, millions", leaves / 1e6)):
            self.figures[most] = max(figure, self.figures.get(most, 0))
        self.curves += curve_rows(fitted.fit)
        self.lines.append(_pictures(fitted))
        if row.capture == ROOM:
            self.depths += _depth_rows(fitted)
        return fitted


def reports(scenes: Scenes, *, rounds: int = 1) -> dict[str, list[Report] | bytes]:
    """Measure every row once: a fit takes minutes, and writes the same bytes in every round."""
    if rounds != 1:
        raise ValueError("fits take minutes, so there is one round")
    folder, collected = scenes.folder / "captures", Collected()
    folder.mkdir()
    for row in ROWS:
        try:
            collected.add(row, partial(_fit_capture, row, scenes, folder))
        except NerfbakeError:
            continue  # its row says why
    _from_photographs(scenes, folder, collected)
    tables = [
        Table("Fits, from the written file", FITS, collected.fits),
        aims_table(_aims(collected.figures)),
        Table(f"From the photographs of {ALONE.capture} alone", STEPS, collected.steps),
        Table(f"Poses of the photographs of {ALONE.capture}", PLACES, collected.places),
        Table("Depths of the room", DEPTHS, collected.depths),
        Table(OVER_TIME, CURVE, collected.curves),
    ]
    head = {"rays a pixel": f"{SAMPLES}x{SAMPLES}", **environment("numpy", "numba", "pycolmap", "nerfbake")}
    return {"captures": [Report("Captures", head, tables, NOTES)], "captures_views": _sheet(collected.lines)}


def _aims(figures: dict[str, float]) -> list[tuple[str, Aim, float | None]]:
    aims = {"largest peak MB": CAPTURE_MEMORY, "most leaves, millions": CAPTURE_LEAVES}
    for name, (seconds, decibels) in CAPTURES.items():
        aims |= {f"{name}: s": seconds, f"{name}: PSNR dB": decibels}
    aims |= {f"poses: {what}": aim for what, aim in POSES.items()}
    aims["photographs to page: s"] = PHOTOGRAPHS_TO_PAGE
    return [(label, aim, figures.get(label)) for label, aim in aims.items()]


def _missing(name: str, error: NerfbakeError, columns: Sequence[str]) -> list[Any]:
    return [f"{name}: {error.line}", *[None] * (len(columns) - 1)]


# -- fits ------------------------------------------------------------------------------------------------------
def _fit_capture(row: Row, scenes: Scenes, folder: Path) -> Fitted:
    return _fitted(row, _capture(row, scenes, folder), folder)


def _capture(row: Row, scenes: Scenes, folder: Path) -> Path:
    """Return the folder of a capture. Shrunk pictures and those of the room are made on the first call."""
    given, made = scenes.captures / row.capture, folder / f"{row.capture}_{row.shrink}"
    if made.exists():
        return made
    if row.capture == ROOM:
        write_sample_capture(made, frames=ROOM_FRAMES, edge=ROOM_EDGE, room=True)
        return made
    _require(given)
    if row.shrink == 1:
        return given
    shrink_capture(given, made, row.shrink)
    return made


def shrink_capture(given: Path, made: Path, shrink: int) -> None:
    """Copy a capture with pictures and masks whose pixels are means of shrink x shrink."""
    shutil.copytree(given, made, ignore=shutil.ignore_patterns("images", "masks"))
    for path in (*given.glob("images/*"), *given.glob("masks/*")):
        own = made / path.relative_to(given)  # the cameras name the pictures with their extensions
        own.parent.mkdir(exist_ok=True)
        with Pillow.open(path) as picture:
            picture.reduce(shrink).save(own, format="PNG")


def _require(capture: Path) -> None:
    if not capture.is_dir():
        raise NerfbakeError("not there")


def _fitted(row: Row, capture: Path, folder: Path) -> Fitted:
    """Fit a capture in a separate process, and read what it wrote. Raises NerfbakeError with its last line."""
    masks = str(capture / "masks") if (capture / "masks").is_dir() else None
    options = [*row.options, *(("--masks", masks) if masks else ())]
    run = _nerfbake("fit", str(capture), str(folder / f"{row.name}.npz"), *options, "--json")
    fit = Fit(row.name, json.loads(run.facts["stdout"]), run.peak)
    views = read_photographs(SILENT, Source(str(capture)), PhotographOptions(masks=masks)).held_out
    decibels = [view["psnr"] for view in fit.facts["views"]]
    return Fitted(fit, run, views, decibels, build_field(load(fit.facts["file"], N3Tree)))


def _nerfbake(*words: str) -> Result:
    with announced(f"nerfbake {' '.join(words)}"):
        return measure_process(sys.executable, "-m", "nerfbake", *words, "-q", keep=True)


def _depth_rows(fitted: Fitted) -> list[list[Any]]:
    """Compare the depths of held-out views of the room with the exact ones, one ray a pixel."""
    rows: list[list[Any]] = []
    for camera, decibels in zip(fitted.views.cameras.cameras, fitted.decibels, strict=True):
        share = render_field(fitted.scene, camera).depth / render_room(camera).depth
        apart = np.abs(share - 1)
        figures = 100 * np.median(apart), np.mean(apart < 0.05), np.mean(share < 0.5)
        rows.append([camera.name, f"{decibels:.2f}", *map(float, figures)])
    return rows


# -- photographs alone -----------------------------------------------------------------------------------------
def _from_photographs(scenes: Scenes, folder: Path, collected: Collected) -> None:
    """Find the poses of photographs, fit a scene to them, and write a page of it."""
    given, photographs = scenes.captures / ALONE.capture, folder / "photographs"
    step, total = "poses", 0.0
    try:
        _require(given)
        shutil.copytree(given / "images", photographs)
        run = _nerfbake("poses", str(photographs), "--json")
        total += _add_step(step, run, collected)
        place = _place_row(json.loads(run.facts["stdout"]), photographs, given)
        collected.places.append(place)
        collected.figures |= {f"poses: {what}": figure for what, figure in zip(POSES, (total, place[-1]), strict=True)}
        step = "fit"
        fitted = collected.add(ALONE, partial(_fitted, ALONE, photographs, folder))
        total += _add_step(step, fitted.run, collected)
        step, page = "view", str(folder / "page.html")
        run = _nerfbake("view", fitted.fit.facts["file"], page, "--cameras", str(photographs))
        total += _add_step(step, run, collected)
    except NerfbakeError as error:
        collected.steps.append(_missing(step, error, STEPS))
        return
    collected.steps.append(["together", total, None, None])
    collected.figures["photographs to page: s"] = total


def _add_step(step: str, run: Result, collected: Collected) -> float:
    """Add the row of a process, and return its CPU seconds / 2."""
    seconds = float(run.facts["worked"] / 2)
    collected.steps.append([step, seconds, run.seconds, run.peak / 1e6])
    return seconds


def _place_row(facts: dict[str, Any], photographs: Path, given: Path) -> list[Any]:
    found, known = (
        {Path(camera.picture).stem: camera.pose[:3, 3] for camera in load(path, Cameras).cameras}
        for path in (photographs, given)
    )
    errors = position_errors(np.array(list(found.values())), np.array([known[name] for name in found]))
    told = [facts[name] for name in ("pictures", "registered", "points", "error")]
    return [*told, 100 * float(errors.mean()), 100 * float(errors.max())]


def position_errors(found: Points, given: Points) -> Points:
    """Return the distances (m,) of positions (m, 3) after the similarity that brings them closest to the given ones.

    They are shares of the largest distance of a given position from their mean. Source: Umeyama (1991).
    """
    middle, aim = found - found.mean(axis=0), given - given.mean(axis=0)
    U, S, Vt = np.linalg.svd(aim.T @ middle)
    signs = np.array([1, 1, np.linalg.det(U @ Vt)])
    moved = middle @ (U * signs @ Vt).T * ((S * signs).sum() / (middle**2).sum())
    return np.asarray(np.linalg.norm(moved - aim, axis=1) / np.linalg.norm(aim, axis=1).max())


# -- pictures --------------------------------------------------------------------------------------------------
def _pictures(fitted: Fitted) -> list[Pixels]:
    """Return photograph and rendering of the median view, then of the worst view, each at most SHOWN wide."""
    order, pictures = np.argsort(fitted.decibels), []
    for number in (int(order[len(order) // 2]), int(order[0])):
        camera = fitted.views.cameras.cameras[number]
        image = render_field(fitted.scene, camera, background=fitted.views.background, samples=SAMPLES)
        for colour in (fitted.views.photograph(number), image.colour):
            pixels = np.rint(255 * colour.clip(0, 1)).astype(np.uint8)
            height = max(1, round(SHOWN * len(pixels) / pixels.shape[1]))
            size = (SHOWN, height) if pixels.shape[1] > SHOWN else pixels.shape[1::-1]
            pictures.append(np.asarray(Pillow.fromarray(pixels).resize(size, Pillow.Resampling.BOX)))
    return pictures


def _sheet(lines: Sequence[Sequence[Pixels]]) -> bytes:
    """Return a PNG of the pictures, line by line on white."""
    heights = [max(len(picture) for picture in line) + GAP for line in lines]
    width = max((sum(picture.shape[1] + GAP for picture in line) for line in lines), default=GAP) - GAP
    sheet = np.full((max(1, sum(heights) - GAP), max(1, width), 3), 255, np.uint8)
    for line, top in zip(lines, np.cumsum([0, *heights]), strict=False):
        left = 0
        for picture in line:
            sheet[top : top + len(picture), left : left + picture.shape[1]] = picture
            left += picture.shape[1] + GAP
    file = BytesIO()
    Pillow.fromarray(sheet).save(file, "PNG", optimize=True)
    return file.getvalue()
