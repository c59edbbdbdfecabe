"""Make the files that several targets need of one scene, judge each, and write a receipt."""

from __future__ import annotations

import re
import tempfile
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, fields
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, NamedTuple

from nerfbake import __version__, catalog, io, memory, progress
from nerfbake.errors import (
    InvalidFile,
    InvalidScene,
    NerfbakeError,
    OutputError,
    PipeClosed,
    Problem,
    Stopped,
    UsageError,
)
from nerfbake.installation import is_installed
from nerfbake.jobs import budgets
from nerfbake.jobs.compressions import compress_file
from nerfbake.jobs.conversions import convert_file, convert_splats
from nerfbake.jobs.devices import renderer_on
from nerfbake.jobs.files import AnySource, FolderTarget, Source, as_source
from nerfbake.jobs.fit_state import Clock
from nerfbake.jobs.fitted_pictures import FittedPictures
from nerfbake.jobs.function_voxels import FunctionVoxels
from nerfbake.jobs.mesh_options import TEXTURE, TRIANGLES, MeshOptions, MeshViews
from nerfbake.jobs.meshes import bake_mesh
from nerfbake.jobs.octrees import bake_octree, bake_volume
from nerfbake.jobs.pages import field_of_page, view_file
from nerfbake.jobs.photographs import PhotographOptions
from nerfbake.jobs.reading_options import ReadingOptions
from nerfbake.jobs.readings import Reading
from nerfbake.jobs.shipping_list import FILES, ListedFile, require_targets
from nerfbake.jobs.splat_choice import SplatChoice
from nerfbake.jobs.splats import SplatsOptions, SplatsViews, bake_splats
from nerfbake.jobs.steps import SILENT, Steps, Tell
from nerfbake.jobs.views import in_one_world, renderable_scene, views_of
from nerfbake.scene.camera import Cameras
from nerfbake.scene.function_field import FunctionField
from nerfbake.scene.image import Image
from nerfbake.scene.lattice_field import LatticeField
from nerfbake.scene.n3tree import N3Tree
from nerfbake.scene.shipment import Judgement, SharedStep, Shipment, ShippedFile
from nerfbake.scene.splats import Splats
from nerfbake.stages.picture import Visible, render_picture
from nerfbake.stages.renderers import Renderer
from nerfbake.stages.scenes_to_comparison import compare_scenes
from nerfbake.stages.splat_box import with_z_up

_PAGE, _FACTS = "report.html", "report.json"
_START = b'{"version": 1, "in": '  # of report.json


def _recognise(files: Mapping[str, memoryview]) -> bool:
    return _FACTS in files and bytes(files[_FACTS][: len(_START)]) == _START


CONTENTS = io.FolderContents(
    "a shipment", re.compile("|".join(re.escape(name) for name in (*FILES, _PAGE, _FACTS))), _recognise
)
_SHOWN = 256  # pixels along the longer edge of a picture in the report, at most
_PACKAGES = {"pxr": "usd-core"}  # the package of a library that reads files for nerfbake


@dataclass(frozen=True, kw_only=True)
class ShippedViews(FittedPictures):
    """The pictures that meshes and splats are fitted to. The arguments are those of FittedPictures.

    device also renders the pictures on which the files are judged.
    """


@dataclass(frozen=True, kw_only=True)
class ShipmentOptions:
    """How large the files are.

    splats     the largest number of splats; None: 150,000 of a field, all of splats
    triangles  the largest number of triangles of a mesh; texture: texels along an edge of its texture
    """

    splats: int | None = None
    triangles: int = TRIANGLES
    texture: int = TEXTURE


def ship_file(
    source: AnySource,
    target: FolderTarget | str | Path,
    *,
    targets: Sequence[str],
    pictures: ShippedViews = ShippedViews(),
    options: ShipmentOptions = ShipmentOptions(),
    functions: FunctionVoxels = FunctionVoxels(),
    cameras: str | None = None,
    steps: Steps = SILENT,
    report: Callable[[Shipment], None] | None = None,
) -> Shipment:
    """Make the files that these targets need of a scene, judge each against it, and return the receipt.

    This is `nerfbake ship`. Reads `source`, any scene with a field, or splats, and the photographs of `pictures`.
    Writes the folder `target` with the files, report.html and report.json. Each file is read back and rendered with the
    same cameras as the scene. If one cannot be made, the others still are; NerfbakeError is raised when the folder is
    complete.

    targets    some of blender, web, ios, unity, omniverse and archive
    functions  how a trained field becomes voxels
    cameras    a capture with the views that files are judged on; None: 8 views around the scene
    report     is called with the receipt once the folder has its final name, also if a file failed

    Raises NerfbakeError.

    >>> shipped = ship_file("a.npz", "shipped", targets=("unity",))
    >>> [(file.name, file.status) for file in shipped.files]
    [('scene.svo.pb', 'judged')]
    """
    source = as_source(source)
    place = target if isinstance(target, FolderTarget) else FolderTarget(str(target))
    wanted = require_targets(tuple(targets))
    pictures.photographs.require()
    if source.path == io.STREAM:
        raise UsageError("ship reads IN several times; allowed: a file, not stdin")
    render = renderer_on(pictures.device, steps=steps)
    place.require(CONTENTS, (source.path, *pictures.inputs, cameras, functions.seen_from))
    with io.blame(place.path, OutputError), io.replacing_folder(Path(place.path), CONTENTS, force=place.force) as out:
        with tempfile.TemporaryDirectory(dir=out) as work:
            told = _Renamed(steps, _names(Path(work), source.name) | {str(out): place.path})
            workshop = _Workshop(told, source, Path(work), pictures, options, functions)
            shipment = _shipped(told, workshop, out, wanted, tuple(dict.fromkeys(targets)), cameras, source, render)
        io.save(out / _PAGE, shipment)
        with io.replacing(out / _FACTS, force=False) as file:
            file.write(f"{io.json_line(shipment.facts)}\n".encode())
    steps.say(f"{place.path}: {shipment}, {_PAGE}")
    if found := [each.judged.psnr for each in shipment.files if each.judged]:
        io.report_result(psnr=min(found))
    if report is not None:
        report(shipment)
    if failed := shipment.failed:
        names = ", ".join(each.name for each in failed)
        problem = Problem(
            f"{len(failed)} of {len(shipment.files)} files", f"failed: {names}", f"{_PAGE} has the reasons"
        )
        raise NerfbakeError(problem, source=place.path)
    return shipment


_NAMED = re.compile(r"`([a-z][a-z0-9_]*)(?:=[^`]*)?`")  # an argument in a message
_OPTIONS = (ShippedViews, PhotographOptions, ShipmentOptions, FunctionVoxels)
_TAKEN = {"cameras", *(each.name for options in _OPTIONS for each in fields(options))}  # by ship_file()


class _Renamed:
    """Passes messages on, with the names of the final files instead of the temporary ones.

    An argument that ship_file() does not take is told with its command, if the message is from the job of one.
    """

    def __init__(self, steps: Steps, names: Mapping[str, str], command: str = "") -> None:
        self._steps, self._names, self._command = steps, names, command

    def of(self, command: str) -> _Renamed:
        """Return what the job of this command gets."""
        return _Renamed(self._steps, self._names, command)

    def named(self, text: str) -> str:
        for path, name in self._names.items():
            text = text.replace(path, name)
        return text

    def say(self, text: str) -> None:
        if self._command:
            text = _NAMED.sub(self._with_command, text)
        self._steps.say(self.named(text))

    def _with_command(self, argument: re.Match[str]) -> str:
        return argument[0] if argument[1] in _TAKEN else f"{argument[0]} of `{self._command}`"

    def phase(self, text: str) -> AbstractContextManager[Tell]:
        return self._steps.phase(self.named(text))


_SHARED = {"scene.npz": "voxels", "scene.svo.npz": "voxels", "splats.ply": "splats"}  # files of shared steps


def _names(work: Path, name: str) -> dict[str, str]:
    return {str(work / file): f"{name} as {what}" for file, what in _SHARED.items()}


class _Workshop:
    """Makes each file by the job of its command. What several files need is made once, when the first one needs it."""

    def __init__(
        self,
        steps: _Renamed,
        source: Source,
        work: Path,
        pictures: ShippedViews,
        options: ShipmentOptions,
        functions: FunctionVoxels,
    ) -> None:
        self._steps, self._source, self._work = steps, source, work
        self._pictures, self._options, self._functions = pictures, options, functions
        self._made: dict[str, Source | NerfbakeError] = {}
        self.shared: list[SharedStep] = []
        reading = Reading(steps, source, functions=functions)
        reading.require()
        self._kind = type(reading.scene)
        if isinstance(reading.scene, Splats) and pictures.views is not None:
            raise UsageError("splats are turned upright, and `views` are not; allowed: it with a field")
        self._up = (reading.scene.up or "-y") if isinstance(reading.scene, Splats) else "z"
        self.content = str(reading.scene)
        if isinstance(reading.scene, FunctionField):
            del reading
            reading = Reading(steps, self.field())
        if isinstance(reading.scene, N3Tree):
            reading.use_inner_cube()
        elif isinstance(reading.scene, Splats):
            with source.blamed(steps, "turning the splats"):
                reading.scene = with_z_up(reading.scene, self._up)
        self.original: Visible = renderable_scene(steps, reading.scene, source.name)

    def field(self) -> Source:
        """Return the scene as a file of a field that every job takes."""
        if issubclass(self._kind, FunctionField):
            return self._once("scene.npz", "the field, baked", self._bake_function)
        if issubclass(self._kind, LatticeField | Splats):
            return self._once("scene.svo.npz", "an octree", self._bake_octree)
        return self._source

    def splats(self) -> Source:
        """Return the scene as splats in a .ply, upright."""
        return self._once("splats.ply", "splats", self._bake_splats)

    def maker(self, name: str) -> Callable[[Path], object]:
        """Return the function that writes this file to a path. Shared steps are run here. Raises NerfbakeError."""
        steps, title = self._steps, catalog.scene_name(self._source.name)
        if name.startswith("splats."):
            splats, choice = self.splats(), SplatChoice(spz_version=3) if name == "splats.spz" else SplatChoice()
            return lambda path: convert_splats(splats, path, choice=choice, steps=steps.of("nerfbake convert"))
        if name.startswith("mesh."):
            # Of splats themselves: their pictures are sharper than those of their voxels.
            shown = self._source if issubclass(self._kind, Splats) else self.field()
            views, options = MeshViews(**vars(self._pictures)), self._options
            size = MeshOptions(triangles=(options.triangles,), texture=options.texture)
            return lambda path: bake_mesh(shown, path, pictures=views, options=size, steps=steps.of("nerfbake mesh"))
        source = self.field()
        return {
            "scene.html": lambda path: view_file(source, path, title=title, steps=steps.of("nerfbake view")),
            "scene.vdb": lambda path: bake_volume(source, path, steps=steps.of("nerfbake vdb")),
            "scene.svoq": lambda path: compress_file(source, path, steps=steps.of("nerfbake compress")),
        }.get(name, lambda path: bake_octree(source, path, steps=steps.of("nerfbake svo")))

    def _bake_function(self, path: Path) -> object:
        return convert_file(self._source, path, functions=self._functions, steps=self._steps.of("nerfbake convert"))

    def _bake_octree(self, path: Path) -> object:
        options = ReadingOptions(in_up=self._up) if issubclass(self._kind, Splats) else ReadingOptions()
        return bake_octree(self._source, path, options=options, steps=self._steps.of("nerfbake svo"))

    def _bake_splats(self, path: Path) -> object:
        source, views = (self._source if issubclass(self._kind, Splats) else self.field()), self._pictures
        if issubclass(self._kind, Splats) and self._options.splats is None:
            return convert_splats(source, path, in_up=self._up, steps=self._steps.of("nerfbake convert"))
        options = SplatsOptions(splats=self._options.splats)
        steps = self._steps.of("nerfbake splats")
        return bake_splats(source, path, SplatsViews(**vars(views)), options=options, in_up=self._up, steps=steps)

    def _once(self, name: str, what: str, make: Callable[[Path], object]) -> Source:
        """Return the file that a step makes, or raise its error, each time that it is needed."""
        if name not in self._made:
            clock, path = Clock(), self._work / name
            try:
                with memory.scope():
                    make(path)
                self._made[name] = Source(str(path))
            except NerfbakeError as error:
                _require_failure(error)
                self._made[name] = error
            self.shared.append(SharedStep(what, clock.passed, clock.worked))
        found = self._made[name]
        if isinstance(found, NerfbakeError):
            raise found
        return found


def _require_failure(error: NerfbakeError) -> None:
    """Raise an error again that ends the whole command: Ctrl-C, a closed pipe."""
    if isinstance(error, Stopped | PipeClosed):
        raise error


class _Judge(NamedTuple):
    """The scene, the views, and the pictures of the scene in these views."""

    steps: Steps
    name: str
    original: Visible
    views: Cameras
    pictures: list[Image]
    render: Renderer

    def judge(self, path: Path, listed: ListedFile) -> Judgement:
        """Read a file back, and compare its pictures with those of the scene. Raises NerfbakeError."""
        with Source(str(path)).blamed(self.steps, f"judging {path}"):
            made: Any = field_of_page(str(path)) if listed.scene is None else io.load(path, listed.scene)
            if isinstance(made, Splats):
                made = made.without_up("z")  # in the files -y is up, in the scene z
            _, made = in_one_world(self.steps, [(self.name, self.original), (str(path), made)])
            found = compare_scenes(self.original, made, self.views, pictures_of_a=self.pictures, render=self.render)
        number = min(range(len(found.views)), key=lambda i: found.views[i]["a_b"]["psnr"])
        worst, mean = found.views[number], found.means["a_b"]
        row = list(found.rows())[number]
        return Judgement(
            mean["psnr"],
            mean["max_error"],
            worst["name"],
            worst["a_b"]["psnr"],
            _read_by(path, listed),
            (_small(row["a"]), _small(row["b"]), _small(row["a_b"])),
        )


def _small(picture: Image) -> Image:
    """Return a picture as means of pixels, so that the report is small."""
    return picture.reduced(-(-max(picture.size) // _SHOWN))


def _library(path: Path, listed: ListedFile) -> str:
    """The module that reads a file for nerfbake, if it is not nerfbake itself."""
    kind = listed.scene.__name__ if listed.scene else ""
    return next(
        (form.library for form in catalog.FORMATS if form.scene == kind and path.name.endswith(form.suffix)), ""
    )


def _read_by(path: Path, listed: ListedFile) -> str:
    if not (library := _library(path, listed)):
        shown = ", as the page's shader gets it" if listed.scene is None else ""
        return f"read back by nerfbake {__version__}{shown}"
    package = _PACKAGES[library]
    try:
        return f"read by {package} {version(package)}"
    except PackageNotFoundError:
        return f"read by {package} of an unknown version"


def _shipped(
    steps: _Renamed,
    workshop: _Workshop,
    out: Path,
    wanted: Mapping[str, tuple[str, ...]],
    targets: tuple[str, ...],
    cameras: str | None,
    source: Source,
    render: Renderer,
) -> Shipment:
    """Make and judge all files. Raises NerfbakeError if the scene itself cannot be read or rendered."""
    name, original = source.name, workshop.original
    if isinstance(original, Splats) and cameras is not None:
        raise UsageError("splats are turned upright, and `cameras` are not; allowed: it with a field")
    views = views_of(steps, original, cameras, name=name, frames=budgets.FRAMES, edge=budgets.EDGE)
    with io.blame(cameras or name):
        views.require_covered()
        views.require_memory(pictures=4)
    with source.blamed(steps, f"rendering {len(views.cameras)} pictures"):
        seen = [
            render_picture(original, camera, samples=views.samples, render=render)
            for camera in progress.each(list(views.cameras))
        ]
    judge = _Judge(steps, name, original, views, seen, render)
    files = tuple(_made(steps, workshop, judge, out / file, each) for file, each in wanted.items())
    width, height = seen[0].size
    where = f"around the scene, {width}x{height} pixels" if cameras is None else f"of {cameras}"
    told = f"{len(seen)} views {where}{views.rays_text}"
    return Shipment(name, workshop.content, targets, files, tuple(workshop.shared), told)


def _made(steps: _Renamed, workshop: _Workshop, judge: _Judge, path: Path, targets: tuple[str, ...]) -> ShippedFile:
    """Make and judge a file. Its error is its row of the receipt."""
    listed = FILES[path.name]
    empty = ShippedFile(path.name, targets, listed.what, listed.readers, 0, 0.0, 0.0, None, "")
    try:
        with memory.scope():
            make = workshop.maker(path.name)
            clock = Clock()
            make(path)
            passed, worked = clock.passed, clock.worked
    except NerfbakeError as error:
        _require_failure(error)
        return _failed(steps, empty, path, error)
    found = empty._replace(bytes=path.stat().st_size, seconds=passed, cpu_seconds=worked)
    if (library := _library(path, listed)) and not is_installed(library):
        return _unjudged(steps, found, path, f"reading it needs {_PACKAGES[library]}, which is not installed")
    try:
        with memory.scope():
            judged = judge.judge(path, listed)
    except (InvalidFile, InvalidScene) as error:  # nobody can read it
        path.unlink()
        return _failed(steps, empty, path, error)
    except NerfbakeError as error:
        _require_failure(error)
        return _unjudged(steps, found, path, steps.named(error.line))
    worst = f"worst view {judged.worst}: {judged.worst_psnr:.2f} dB"
    steps.say(f"{path}: {judged.psnr:.2f} dB against {judge.name}; {worst}; largest error {judged.max_error:.3f}")
    return found._replace(judged=judged)


def _failed(steps: _Renamed, row: ShippedFile, path: Path, error: NerfbakeError) -> ShippedFile:
    reason = steps.named(error.line)
    steps.say(f"{path}: failed: {reason}")
    return row._replace(reason=reason)


def _unjudged(steps: _Renamed, row: ShippedFile, path: Path, reason: str) -> ShippedFile:
    steps.say(f"{path}: not judged: {reason}")
    return row._replace(reason=reason)
