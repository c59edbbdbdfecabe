"""Run the steps of commands on the file of a case, and collect findings.

A finding is any exception except NerfbakeError, any Python warning, a message with unprintable characters or more than
LONGEST_LINE characters, a load that takes more than MOST_LOADING CPU seconds or more memory than its limit, a case that
takes more than MOST_IN_ALL CPU seconds, and a file that nerfbake writes and cannot read back.
"""

from __future__ import annotations

import re
import time
import traceback
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np

import nerfbake
from nerfbake import catalog, io
from nerfbake.batch.items import parse_lines
from nerfbake.batch.report import write_report
from nerfbake.errors import NerfbakeError
from nerfbake.jobs.batches import Batch, Item, run_batch
from nerfbake.kernels.maths.elementary import fibonacci
from nerfbake.memory import memory_limit
from nerfbake.scene.camera import Camera
from nerfbake.stages.picture import render_picture, renderable
from nerfbake.stages.views_to_field import FitState
from tests.fuzz import corpus
from tests.fuzz.breakage import Case
from tests.fuzz.corpus import CHECKPOINT, LINES, STATE
from tests.support.octrees import small_octree
from tests.support.peaks import peak, resident
from tests.support.views import sample_views

LIMIT = 64 << 20  # bytes: the memory limit of every case
SLACK = 16 << 20  # bytes that the interpreter itself may allocate meanwhile
MOST_LOADING, MOST_IN_ALL = 2.0, 10.0  # seconds of CPU
LONGEST_LINE = 300  # characters, without the file's name
EDGE = 8  # pixels of a picture

GRIDS: tuple[tuple[str, ...], ...] = (("density", "Cd"), ("density", "sh"), ("index",))


@dataclass(frozen=True)
class Finding:
    """A problem and its location. Findings with the same cause have the same `key`."""

    case: int
    form: str
    step: str
    what: str
    where: str = ""

    @property
    def key(self) -> str:
        return re.sub(
            r"[0-9][0-9.,]*",
            "#",
            f"{self.what[:80]} @ {self.where}" if self.where else f"{self.what[:80]} @ {self.form}",
        )


class _Found(Exception):
    pass


class Trial:
    """Tries one case in its own folder."""

    def __init__(self, case: Case, place: Path) -> None:
        self.case, self.place = case, place
        self.step, self.findings = "", list[Finding]()

    def run(self) -> list[Finding]:
        path = put(self.case, self.place)
        start = time.process_time()
        with suppress(_Found), memory_limit(LIMIT):
            scene = self._loaded(path)
            if scene is not None:
                for step, work in steps(scene, self.place):
                    self._try(step, work)
        if (took := time.process_time() - start) > MOST_IN_ALL and not self.findings:
            self._note(f"takes {took:.1f} s of CPU in all")
        return self.findings

    def _loaded(self, path: Path) -> Any:
        """Load the scene and return it if it is sound, else None."""
        before = resident()
        start = time.process_time()
        scene = self._try("load", lambda: _read(self.case.form, path))
        took, most = time.process_time() - start, peak() - before
        if took > MOST_LOADING:
            self._note(f"takes {took:.1f} s of CPU to load")
        if most > LIMIT + SLACK:
            self._note(f"takes {most >> 20} MiB to load, allowed {LIMIT >> 20}")
        if scene is None:
            return None
        if isinstance(scene, (FitState, Batch)):  # these are checked when they are created
            return scene
        problems = self._try("check", scene.problems)
        for problem in problems or []:
            self._hold_to_a_line(str(problem.line))
        return None if self._try("soundness", lambda: (scene.require_sound(), True)) is None else scene

    def _try(self, step: str, work: Callable[[], Any]) -> Any:
        """Return the result of a step, or None if it raises NerfbakeError. Record other problems as findings."""
        self.step = step
        with self._watched(), warnings.catch_warnings(record=True) as warned:
            warnings.simplefilter("always")
            try:
                return work()
            except NerfbakeError as error:
                self._hold_to_a_line(str(error))
                return None
            finally:
                for warning in warned:
                    where = f"{warning.filename}:{warning.lineno}"
                    self._note(f"{warning.category.__name__}: {warning.message}", where)

    @contextmanager
    def _watched(self) -> Iterator[None]:
        try:
            yield
        except Exception as error:
            frames = traceback.extract_tb(error.__traceback__)
            ours = [frame for frame in frames if "/nerfbake/" in frame.filename] or frames[-1:]
            where = f"{ours[-1].filename}:{ours[-1].lineno}" if ours else ""
            self._note(f"{type(error).__name__}: {error}"[:300], where)
            raise _Found from None

    def _hold_to_a_line(self, line: str) -> None:
        text = re.sub(rf"^{re.escape(str(self.place))}/[^:]*: ", "", line)  # checkpoints are renamed
        if not line.isprintable():
            self._note(f"message with unprintable characters: {text[:100]!r}")
        if len(text) > LONGEST_LINE:
            self._note(f"message of {len(text):,} characters: {text[:100]}")

    def _note(self, what: str, where: str = "") -> None:
        place = re.sub(r".*/(?=nerfbake/|tests/|site-packages/)", "", where)
        self.findings.append(Finding(self.case.number, self.case.form, self.step, what, place))


def _read(form: str, path: Path) -> Any:
    """Load a scene; for a checkpoint, the state of the fit; for lines and a state of a batch, the batch."""
    if form == LINES:
        return run_batch(_items(path), state=path.parent / "none", run=None)
    if form == STATE:
        return run_batch(_items(path / "plan.txt"), state=path, run=None)
    if form != CHECKPOINT:
        return io.load(path, sound=False)
    path.replace(io.checkpoint_path(path.parent))
    found = io.load_checkpoint(path.parent)
    return None if found is None else FitState.of_arrays(found[1])


def _items(path: Path) -> list[Item]:
    """The items of a file of lines. Their first two arguments after the command count as input and output."""
    lines = parse_lines(io.load_lines(path), path.name)
    return [Item(line.argv, line.argv[1:2], line.argv[2:3]) for line in lines]


def put(case: Case, place: Path) -> Path:
    """Write the file or folder of a case, and return its path."""
    path = place / case.name
    for name, content in corpus.beside(case.form).items():
        (place / name).write_bytes(content)
    if isinstance(case.content, bytes):
        path.write_bytes(case.content)
        return path
    path.mkdir()
    for name, content in case.content.items():
        (path / name).parent.mkdir(parents=True, exist_ok=True)
        (path / name).write_bytes(content)
    return path


def steps(scene: Any, place: Path) -> Iterator[tuple[str, Callable[[], Any]]]:
    """The steps that commands run on a scene: describe, render, write and convert it."""
    if isinstance(scene, FitState):
        views = sample_views(frames=3, width=16, height=16)
        yield "go on", lambda: next(nerfbake.fit_field(views, schedule=scene.schedule, start=scene), None)
        return
    if isinstance(scene, Batch):
        yield "told", lambda: [*scene.summary.split(), scene.exit_code, scene.totals]
        for ending in (".html", ".md", ".csv"):
            yield f"report {ending}", partial(write_report, scene, place / f"report{ending}", state=place / "reports")
        return
    yield "words", lambda: str(scene)
    kind = type(scene).__name__
    radiance = (nerfbake.N3Tree, nerfbake.SparseVoxelOctree, nerfbake.Volume)
    lattice = isinstance(scene, nerfbake.LatticeField)
    if lattice or isinstance(scene, (*radiance, nerfbake.Meshes)):
        yield "info", lambda: nerfbake.summarise_scene(scene)
    if lattice or isinstance(scene, (*radiance, nerfbake.Meshes, nerfbake.Stage1, nerfbake.BakedAtlas)):
        yield "render", lambda: _drawn(scene)
    if isinstance(scene, radiance):
        yield "trilinear", lambda: _trilinear(scene)
    if isinstance(scene, nerfbake.FunctionField):
        yield "points", lambda: _evaluated(scene)
    if isinstance(scene, nerfbake.Cameras):
        yield (
            "cameras",
            lambda: [nerfbake.render_field(_field(), camera.resized(EDGE, EDGE)) for camera in scene.cameras[:3]],
        )
        yield "names", lambda: [camera.name.encode() for camera in scene.cameras]
    for form in catalog.formats_of(kind):
        yield f"write {form.name}", partial(_written, form, scene, place)
    if lattice:
        yield "lattice", lambda: nerfbake.build_octree_from_lattice(scene, resolution=(3, 4, 5), basis="SH4")
    if isinstance(scene, nerfbake.N3Tree):
        yield "svo", lambda: nerfbake.build_octree(scene, resolution=4)
        yield "vdb", lambda: nerfbake.build_vdb(nerfbake.build_octree(scene, resolution=8))
    if isinstance(scene, nerfbake.Volume):
        yield "restore", lambda: nerfbake.build_octree_from_volume(scene)
    if isinstance(scene, nerfbake.SparseVoxelOctree):
        yield "lod", lambda: nerfbake.cut_octree(scene, level=1)
        for grids in GRIDS:
            for form in catalog.formats_of("Volume"):
                if len(grids) == 1 or form.name != "nvdb":
                    yield f"vdb {form.name}", partial(_volume, form, scene, grids, place)


@cache
def _field() -> nerfbake.RadianceField:
    return nerfbake.build_field(small_octree())


def _view(scene: Any) -> Camera:
    return nerfbake.orbit_cameras(scene, width=EDGE, height=EDGE).cameras[0]


def _drawn(scene: Any) -> Any:
    seen = renderable(scene)
    return render_picture(seen, _view(seen)).pixels


def _evaluated(scene: nerfbake.FunctionField) -> Any:
    """Densities and colours at points in and around the scene's box. Values that are not finite are found first."""
    scene.require_usable()
    low, high = scene.world_box
    points = low + np.random.default_rng(1).random((40, 3)) * 1.2 * (high - low)
    density, features = scene.density(points)
    return density, scene.colour(features, fibonacci(40))


def _trilinear(scene: Any) -> Any:
    field = nerfbake.build_field(scene)
    return nerfbake.render_field(field, _view(field), lookup="trilinear")


def _written(form: catalog.Format, scene: Any, place: Path) -> None:
    """Write a scene, and check that it is the same when read back."""
    path = place / f"out{form.suffix}"
    io.save(path, scene, force=True)
    if not form.readable or (form.library and isinstance(scene, nerfbake.Cameras)):
        return
    again: Any = form.load_stored_module().stored(scene) if form.library else io.load(path)
    if _told(again) != _told(scene):
        raise AssertionError(f"was {_told(scene)}, comes back as {_told(again)}")


def _told(scene: Any) -> str:
    """The properties that every format preserves. Depth loses digits, and meshes lose unused vertices."""
    if isinstance(scene, nerfbake.Cameras):
        return f"{len(scene.cameras)} cameras"
    if isinstance(scene, nerfbake.Meshes):
        return f"{sum(len(mesh.faces) for mesh in scene.meshes)} triangles"  # a .ply joins all meshes
    if isinstance(scene, nerfbake.Volume):  # a NanoVDB of halves is read as float32
        return ", ".join(f"{grid.name} of {grid.topology.m} voxels" for grid in scene.grids)
    return str(scene.distance.shape) if isinstance(scene, nerfbake.Depth) else str(scene)


def _volume(form: catalog.Format, octree: Any, grids: tuple[str, ...], place: Path) -> None:
    if form.name == "vdb" and "index" in grids:
        return
    half = bool(octree.n & 1)
    _written(form, nerfbake.build_vdb(octree, grids=grids, half=half), place)
