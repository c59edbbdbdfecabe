"""Benchmark of a graphics card: fits, and pictures a second, beside the CPU of the same machine.

Every fit is a whole process, measured twice; the second run has compiled kernels and shaders. PSNR is that of the
written file on the held-out views, measured on the same device. The suite takes less than eight minutes on a card. Run
it with `python -m benchmarks gpu`; NERFBAKE_DEVICE names another device than the first card.
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Sequence
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

from benchmarks.captures import shrink_capture
from benchmarks.processes import announced, measure_process
from benchmarks.scenes import Scenes
from nerfbake import Cameras, Splats, build_field, io, memory_limit, orbit_cameras
from nerfbake.bench.environment import environment
from nerfbake.bench.measure import Result, Work, measure
from nerfbake.bench.report import Report, Table
from nerfbake.device.adapters import GPU, open_device
from nerfbake.errors import NerfbakeError
from nerfbake.jobs.devices import renderer_with
from nerfbake.jobs.steps import SILENT

DEVICE = os.environ.get("NERFBAKE_DEVICE", GPU)
FITS = ["fit", "device", "s, first run", "s, second run", "alone s", "PSNR dB", "MB"]
RENDERS = ["scene", "device", "pictures", "ms a picture", "pictures a second"]
NOTES = [
    "s: whole processes, with reading the photographs and measuring the file. alone: CPU seconds of the second run's "
    "main thread outside of work that it shares with others (benchmarks.alone): more cores do not shorten them.",
    "Pictures are rendered at 800x800 and read back, without a PNG.",
]


class Row(NamedTuple):
    """A fit. source: a capture of the scenes. shrink: edge in pixels of the squares that are averaged."""

    name: str
    source: str
    options: tuple[str, ...]
    shrink: int = 1
    device: str = ""  # DEVICE


ROWS = (
    Row("chair 800x800, best", "nerf_synthetic_800/chair", ("--preset", "best")),
    Row("chair 400x400, fast", "nerf_synthetic/chair", ("--preset", "fast")),
    Row("plush 504x378, balanced", "captures/plush", ("--preset", "balanced"), 2),
    Row("chair 400x400, fast", "nerf_synthetic/chair", ("--preset", "fast"), device="cpu"),
)
SHOWN = (  # name, file and cameras, or an orbit
    ("chair 256^3", "plenoctree/chair/chair_sh9.npz", "nerf_synthetic/chair/transforms_test.json"),
    ("biker, 152,746 splats", "splats/biker.spz", ""),
)
FRAMES, EDGE = 100, 800
_ORBIT = 8


def reports(scenes: Scenes, *, rounds: int = 1) -> dict[str, list[Report]]:
    if rounds != 1:
        raise ValueError("a fit has the same bytes in every round; allowed: rounds=1")
    open_device(DEVICE)  # raises if there is none
    with TemporaryDirectory(prefix="nerfbake-gpu-") as name:
        fits = Table("Fits", FITS, [_fitted(row, scenes, Path(name)) for row in ROWS])
    renders = Table("Pictures", RENDERS, [_rendered(*each, scenes) for each in product(SHOWN, (DEVICE, "cpu"))])
    report = Report("A graphics card", environment("numpy", "numba", "wgpu"), [fits, renders], NOTES)
    return {"gpu": [report]}


def _fitted(row: Row, scenes: Scenes, folder: Path) -> list[Any]:
    source, device = scenes.data / row.source, row.device or DEVICE
    try:
        if row.shrink > 1:
            made = folder / source.name
            if not made.exists():
                shrink_capture(source, made, row.shrink)
            source = made
        found = []
        for turn in ("first", "second"):
            with announced(f"{row.name} on {device}, {turn} run"):
                words = ("fit", str(source), str(folder / "out.npz"), *row.options, "--device", device)
                found.append(_run(folder / "facts.json", words))
                alone = json.loads((folder / "facts.json").read_text())["alone"]
    except NerfbakeError as error:
        return [f"{row.name}: {error.line}", device, None, None, None, None, None]
    facts = json.loads(found[1].facts["stdout"])
    seconds = [run.seconds for run in found]
    return [row.name, facts["device"], *seconds, alone, f"{facts['psnr']:.2f}", facts["bytes"] / 1e6]


def _run(facts: Path, words: Sequence[str]) -> Result:
    run = (sys.executable, "-m", "benchmarks.alone", str(facts), *words)
    return measure_process(*run, "--json", "-q", "--force", keep=True)


def _rendered(shown: tuple[str, str, str], device: str, scenes: Scenes) -> list[Any]:
    (name, file, cameras), frames = shown, FRAMES if device != "cpu" else 4
    with announced(f"rendering {frames} pictures of {name} on {device}"):
        path, seen = str(scenes.data / file), str(scenes.data / cameras) if cameras else None
        found = measure(rendering, path=path, cameras=seen, device=device, frames=frames, edge=EDGE)
    if found.error:
        return [f"{name}: {found.error}", device, None, None, None]
    each = found.seconds / frames
    return [name, found.facts["device"], frames, 1000 * each, f"{1 / each:.1f}"]


def rendering(path: str, cameras: str | None, device: str, frames: int, edge: int) -> Work:
    """The work of rendering pictures one after the other; called in a child process."""
    with memory_limit(1 << 46):
        read: Any = io.load(path)
        scene = read if isinstance(read, Splats) else build_field(read)
    if cameras is None:
        views = list(orbit_cameras(scene, frames=_ORBIT, width=edge, height=edge).cameras)
    else:
        views = [camera.resized(edge, edge) for camera in io.load(cameras, Cameras).cameras]
    views = [views[number % len(views)] for number in range(frames)]
    gpu = open_device(device)
    render = renderer_with(SILENT, gpu)
    render(scene, views[0])

    def run() -> int:
        return sum(1 for _ in render.each(scene, views))

    return Work(run, lambda _: {"device": "cpu" if gpu is None else gpu.name})
