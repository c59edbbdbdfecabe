"""Scenes on which the loss that `nerfbake compress` promises is compared with the measured one, for `compress`.

Each scene is compressed without its photographs for two losses, once with its PSNR as --source-psnr and once without.
The loss is then measured on views that the scene was not fitted to: the photographs of the chair with one ray a pixel;
the pixels that fits of photographs store, with 2x2; pictures of the splats that an octree was made from. A scene that
is missing keeps its row and says so.

A factor tells how much more a file loses than independent errors of the same size would: M (10^(loss / 10) - 1) / m,
with the m and M of docs/compression.md. The second table leaves out each scene in turn, and doubles the largest factor
of the others, since the margin of the prediction is almost twice the largest factor of all.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from benchmarks.aims import COMPRESS_PROMISES, aims_table
from benchmarks.captures import shrink_capture
from benchmarks.processes import announced, measure_process
from benchmarks.scenes import Scenes
from nerfbake import Cameras, Splats, io, load, render_splats, scatter_cameras
from nerfbake.bench.environment import environment
from nerfbake.bench.report import Report, Table
from nerfbake.errors import NerfbakeError
from nerfbake.jobs import CompressionGoal, GroundTruth, compress_file
from nerfbake.jobs.files import Source
from nerfbake.jobs.readings import Reading
from nerfbake.jobs.samples import write_sample_capture
from nerfbake.jobs.splat_voxels import sample_splats
from nerfbake.jobs.steps import SILENT
from nerfbake.scene.held_out import HeldOut
from nerfbake.scene.image import Image
from nerfbake.scene.octree import SparseVoxelOctree
from nerfbake.stages.loss import MARGIN, SOURCE_PSNR, measuring_judge
from nerfbake.stages.scene_to_field import build_field_from_octree

GOALS = (0.1, 0.3)  # dB
FRAMES, EDGE = 40, 256  # photographs of the sample
SHRINK = 4
VOXELS, JUDGES, PICTURE, ZOOM = 256, 12, 300, 1.4  # of the octree of the splats, and their pictures from near by
FIT = ("--resolution", "64", "--minutes", "0.3")
ROWS = ["scene", "PSNR dB", "given", "goal dB", "MB", "expected dB", "promised dB", "measured dB", "factor", "kept"]
LEFT = ["scene left out", "largest factor of the others", "doubled", "its own", "covered"]
NOTES = [
    f"given: as --source-psnr; without it, {SOURCE_PSNR:g} dB is assumed. expected: loss of the squared error, if it "
    f"were independent; promised: loss of {MARGIN:g} times the squared error; measured: loss of the mean PSNR.",
    "factor: of the squared error, for the measured loss and the measured PSNR.",
    f"fitted: `nerfbake fit {' '.join(FIT)}`.",
]


class Known(NamedTuple):
    """A file with an octree, and pixels that its loss is measured on."""

    path: Path
    octree: SparseVoxelOctree
    held_out: HeldOut


def promise_report(scenes: Scenes) -> Report:
    """Compress every scene, and return the report."""
    rows: list[list[Any]] = []
    factors: dict[str, float] = {}
    for name, make in _makers(scenes):
        try:
            with announced(f"making {name}"):
                known = make()
        except NerfbakeError as error:
            rows.append([f"{name}: {error.line}", *[None] * (len(ROWS) - 1)])
            continue
        found = list(_rows(name, known))
        rows += found
        factors[name] = max(float(row[ROWS.index("factor")]) for row in found)
    shares = [float(row[ROWS.index("measured dB")]) / float(row[ROWS.index("promised dB")]) for row in rows if row[1]]
    aims = [("largest measured / promised", COMPRESS_PROMISES, max(shares, default=None))]
    tables = [Table("Promised and measured", ROWS, rows), Table("Left out", LEFT, _left_out(factors))]
    head = {"margin": f"{MARGIN:g}", **environment("numpy", "numba")}
    return Report("Compression: the promised loss", head, [*tables, aims_table(aims)], NOTES)


def _rows(name: str, known: Known) -> Iterator[list[Any]]:
    meter = measuring_judge(build_field_from_octree(known.octree), known.held_out)
    target = known.path.with_suffix(".svoq")
    io.save(str(known.path), known.octree)
    for given in (float(f"{meter.source_psnr:.1f}"), None):
        for goal in GOALS:
            with announced(f"compressing {name}"):
                photographs = GroundTruth(source_psnr=SOURCE_PSNR if given is None else given)
                found = compress_file(known.path, target, goal=CompressionGoal(max_loss=goal), photographs=photographs)
                measured = meter.cost(build_field_from_octree(found.quantised.restored())).loss
            target.unlink()
            factor = meter.source_error * (10 ** (measured / 10) - 1) / found.error
            told = [f"{each:.3f}" for each in (found.expected, found.loss, measured)]
            kept = measured <= found.loss
            yield [name, f"{meter.source_psnr:.2f}", given, goal, found.size / 1e6, *told, f"{factor:.2f}", kept]


def _left_out(factors: dict[str, float]) -> list[list[Any]]:
    rows: list[list[Any]] = []
    for name, own in factors.items():
        most = max((factor for other, factor in factors.items() if other != name), default=0.0)
        rows.append([name, f"{most:.2f}", f"{2 * most:.2f}", f"{own:.2f}", own <= 2 * most])
    return rows


# -- scenes ----------------------------------------------------------------------------------------------------
def _makers(scenes: Scenes) -> list[tuple[str, Callable[[], Known]]]:
    """Return the scenes: a name, and a function that makes the octree in a folder of its own."""
    folder = scenes.folder / "promises"
    folder.mkdir()
    sample = folder / "sample"
    return [
        ("chair, 256^3", partial(_chair, scenes, scenes.chair, folder)),
        ("chair, 128^3", partial(_chair, scenes, scenes.chairs / "chair_sh9_128.npz", folder)),
        ("chair, fitted", partial(_fitted, scenes.capture, folder / "chair.npz")),
        (f"mug, shrunk {SHRINK}x, fitted", partial(_mug, scenes.captures / "mug", folder / "mug")),
        ("sample, fitted", partial(_sample, sample, folder / "sample.npz")),
        (f"biker, splats as {VOXELS}^3", partial(_splats, scenes.splats / "biker.spz", folder)),
    ]


def _chair(scenes: Scenes, path: Path, folder: Path) -> Known:
    cameras = load(scenes.test_cameras, Cameras)
    truth = io.Truth(str(scenes.test_cameras.parent / "test"), cameras.names, Image)
    return _known(path, folder / f"{path.stem}.svo.npz", HeldOut.of_images(cameras.fitting(truth), truth))


def _fitted(capture: Path, path: Path, *options: str) -> Known:
    _require(capture)
    measure_process(sys.executable, "-m", "nerfbake", "fit", str(capture), str(path), *FIT, *options, "-q")
    return _known(path, path.with_suffix(".svo.npz"))


def _mug(given: Path, capture: Path) -> Known:
    _require(given)
    shrink_capture(given, capture, SHRINK)
    return _fitted(capture, capture.with_suffix(".npz"), "--masks", str(capture / "masks"))


def _sample(capture: Path, path: Path) -> Known:
    write_sample_capture(capture, frames=FRAMES, edge=EDGE)
    return _fitted(capture, path)


def _splats(path: Path, folder: Path) -> Known:
    _require(path)
    splats = load(path, Splats)
    octree, seen = sample_splats(SILENT, Source(str(path)), splats, resolution=VOXELS)
    cameras = scatter_cameras(seen, frames=JUDGES, edge=PICTURE, zoom=ZOOM)
    pictures = (render_splats(seen, camera) for camera in cameras.cameras)
    return Known(folder / "splats.svo.npz", octree, HeldOut.of_images(cameras, pictures))


def _require(path: Path) -> None:
    if not path.exists():
        raise NerfbakeError("not there")


def _known(path: Path, target: Path, held_out: HeldOut | None = None) -> Known:
    read = Reading(SILENT, Source(str(path)))
    octree = read.octree()
    held_out = read.held_out if held_out is None else held_out
    if held_out is None:
        raise NerfbakeError("no held-out pixels")
    return Known(target, octree, held_out)
