"""Turn radiance fields into textured meshes, and measure them on views that the textures were not fitted to."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from nerfbake import io, progress
from nerfbake.errors import UsageError
from nerfbake.jobs.budgets import FRAMES, Budget, reporting
from nerfbake.jobs.files import (
    AnySource,
    AnyTarget,
    FolderTarget,
    Source,
    Target,
    as_source,
    as_target,
    read_back,
    read_back_as,
)
from nerfbake.jobs.fit_state import Clock
from nerfbake.jobs.function_voxels import FunctionVoxels
from nerfbake.jobs.mesh_options import SAMPLES, MeshFile, MeshOptions, MeshViews
from nerfbake.jobs.photographs import MeasuredViews, mean_of
from nerfbake.jobs.readings import FIELDS, Reading, upright_without
from nerfbake.jobs.steps import SILENT, Steps
from nerfbake.jobs.views import picture_views
from nerfbake.scene.environment import EnvironmentMap
from nerfbake.scene.mesh import Mesh, Meshes
from nerfbake.scene.radiance_field import RadianceField
from nerfbake.scene.splats import Splats
from nerfbake.scene.stage1 import Stage1
from nerfbake.scene.views import Views, world_box
from nerfbake.stages.texture_to_vertices import colour_vertices
from nerfbake.stages.views_to_error import ViewError, measure_silhouettes, measure_views

if TYPE_CHECKING:
    from nerfbake.stages.views_and_light_to_materials import Material

_RIM_ROUNDS = 2  # of moving the vertices to the rims of the silhouettes
# Turns of fitting the texture and moving the vertices to where it has the colours of the views, and rounds of moving in
# each turn. The chair fitted to 88 of its training photographs and measured on the other 12: 30.8 dB with one round a
# turn, 31.0 with four, and also 31.0 with three turns of three or four turns of two.
_TURNS, _MOVES = 2, 4
_TURN_TEXTURE = 1024  # most texels along an edge in these turns: move_vertices() reduces pictures to about 400 pixels
_LEAST_TEXTURE = 64  # texels along an edge, of a coarse level of detail
_COUNTED = 0.03  # share by which the number of triangles may differ from the one that was asked for without a line


@dataclass(frozen=True)
class MeshQuality(MeasuredViews):
    """How near a mesh comes to held-out views.

    views        error of its pictures on each of them, with highlights if it has any
    diffuse      the same without highlights; None if it has none
    silhouettes  intersection over union of its silhouette and the photograph's, for each view
    judged_on    what it was measured on, in words
    lit          of a mesh with materials: PSNR in dB under the map, on the pixels that the mesh covers, of each view
                 that it is in. `views` are then errors of the albedo alone, which say nothing about the file
    """

    views: tuple[ViewError, ...]
    diffuse: tuple[ViewError, ...] | None
    silhouettes: tuple[float, ...]
    judged_on: str
    lit: tuple[float, ...] | None = None

    @property
    def psnr(self) -> float:
        """Mean PSNR over the views in dB; of a mesh with materials, under the map."""
        if self.lit:
            return sum(self.lit) / len(self.lit)
        return super().psnr

    @property
    def iou(self) -> float:
        """Mean intersection over union of the silhouettes."""
        return sum(self.silhouettes) / len(self.silhouettes)

    @property
    def worst(self) -> ViewError:
        """The view with the lowest PSNR."""
        return min(self.views, key=lambda view: view.psnr)

    def __str__(self) -> str:
        if self.lit:
            text = (
                f"{self.psnr:.2f} dB under the map on the pixels that the mesh covers (worst view {min(self.lit):.2f})"
            )
            return f"{text}, silhouettes' IoU {self.iou:.4f} on {self.judged_on}"
        plain = ""
        if self.diffuse is not None:
            psnr, ssim = mean_of(self.diffuse, "psnr"), mean_of(self.diffuse, "ssim")
            plain = f" ({psnr:.2f} dB, SSIM {ssim:.4f} without highlights)"
        text = f"{self.psnr:.2f} dB, SSIM {self.ssim:.4f}{plain}, silhouettes' IoU {self.iou:.4f} on {self.judged_on}"
        return f"{text}; worst view {self.worst.name}: {self.worst.psnr:.2f} dB"


class MeshResult(NamedTuple):
    """A mesh, measured on the written file or folder.

    path       its path; content: description of its contents; bytes: its size, with the files beside it
    triangles  of each level of detail
    quality    how near it comes to the held-out views
    worked     CPU seconds, without compiling kernels, rendering pictures and measuring
    materials  of the finest level, the largest first; empty without a map of the light
    """

    path: str
    content: str
    bytes: int
    triangles: tuple[int, ...]
    quality: MeshQuality
    worked: float
    materials: tuple[Material, ...] = ()


def bake_mesh(
    source: AnySource,
    target: AnyTarget | FolderTarget,
    *,
    pictures: MeshViews = MeshViews(),
    options: MeshOptions = MeshOptions(),
    file: MeshFile = MeshFile(),
    functions: FunctionVoxels = FunctionVoxels(),
    min_psnr: float | None = None,
    steps: Steps = SILENT,
    report: Callable[[MeshResult], None] | None = None,
) -> MeshResult:
    """Turn a radiance field into a textured mesh and return the quality of its file. This is `nerfbake mesh`.

    Reads `source`, a PlenOctree, an octree, a volume with colours, a lattice or splats, of a scene with scenery the
    inner cube, and the photographs of `pictures`. Without photographs, -y of splats becomes z, as in view_file(). The
    meshes of nerf2mesh and MobileNeRF stay: colour_meshes() makes their textures. Writes `target`: a file with one
    texture or with colours at the vertices, depending on its format, or a folder as nerf2mesh's stage 1, with the
    highlights that `nerfbake atlas` bakes. Raises NerfbakeError.

    functions  how a trained field becomes voxels
    min_psnr  lowest allowed mean PSNR on the held-out views, in dB; below it the output becomes `target`.rejected and
              BudgetMissed is raised (exit code 3)
    report    is called with the result, also if min_psnr is missed

    >>> options = MeshOptions(triangles=(2000,), texture=256)
    >>> made = bake_mesh("a.npz", "a.glb", pictures=MeshViews(frames=8, edge=64), options=options)
    >>> made.quality.psnr > 15
    True
    """
    source, place = as_source(source), mesh_target(target)
    pictures.photographs.require()
    format_options = require_mesh(place, options, file, inputs=(source.path, *pictures.inputs, file.environment))
    if isinstance(place, FolderTarget):
        Budget(min_psnr=min_psnr).require_folder(place, "Stage1", (source.path, *pictures.inputs))
    else:
        Budget(min_psnr=min_psnr).require(place)
    light = None if file.environment is None else _read_light(steps, Source(file.environment))
    kinds = *FIELDS, Stage1
    reading = Reading(steps, source, *kinds, options=upright_without(pictures.views), functions=functions)
    reading.require()
    if isinstance(reading.scene, Stage1):
        if isinstance(place, FolderTarget) or pictures.views or light is not None or options != MeshOptions():
            raise UsageError(
                f"{source.name} is a mesh already, which keeps its triangles and gets a texture of mean colours; "
                "allowed: an OUT with an extension, `in_up`, `lit`, `image` and `min_psnr`"
            )
        return _flat(steps, source, place, reading.scene, pictures.edge, format_options, min_psnr, report)
    scenery = reading.use_inner_cube()
    field = reading.field(visible="no surface")
    splats = reading.shown if isinstance(reading.shown, Splats) else None
    del reading
    split = pictures.split(steps, source, field, splats, scenery=scenery)
    del splats
    clock = Clock()
    scene = build_mesh(steps, source, field, split.training, place, options)
    materials: tuple[Material, ...] = ()
    if light is not None and isinstance(scene, Meshes):
        scene, materials = _with_materials(steps, source, scene, split.training, light)
    worked = clock.worked
    del field
    reported = reporting(lambda: report(found) if report is not None else None)
    with reported, place.writing(steps, scene, **format_options) as written:
        count = len(split.held_out.pictures)
        judged_on = str(split.held_out) if pictures.views else f"{count} pictures of {source.name}"
        loaded, quality = _judged(steps, place, written.path, split.held_out, judged_on, scene, format_options)
        if light is not None:
            written_mesh = replace(_levels(loaded)[0], material=_levels(scene)[0].material)
            quality = replace(quality, lit=_lit(steps, source, written_mesh, split.held_out, light))
        levels = tuple(len(mesh.faces) for mesh in _levels(scene))
        found = MeshResult(place.path, str(loaded), written.size, levels, quality, worked, materials)
        if file.lit and light is None:
            steps.say(f"{place.path}: roughness is 1 everywhere: materials need a map of the light")
        for number, each in enumerate(materials):
            what = f"roughness {each.roughness:.2f}, specular strength {each.specular:.2f}"
            steps.say(f"{place.path}: material {number}: {each.share:.1%} of the texels, {what}")
        _tell_quality(steps, found, min_psnr)
    return found


def _flat(
    steps: Steps,
    source: Source,
    place: Target,
    stage1: Stage1,
    edge: int,
    format_options: dict[str, Any],
    min_psnr: float | None,
    report: Callable[[MeshResult], None] | None,
) -> MeshResult:
    """Write a stage-1 scene's meshes with colours that do not depend on the direction, and measure the file."""
    from nerfbake.stages.scene_to_cameras import orbit_cameras
    from nerfbake.stages.stage1_to_meshes import colour_meshes

    with source.blamed(steps, f"rendering {FRAMES} pictures of {source.name}"):
        cameras = orbit_cameras(stage1, frames=FRAMES, width=edge, height=edge)
        held_out = picture_views(stage1, cameras, SAMPLES)
    clock = Clock()
    with source.blamed(steps, "averaging the colours of texels"):
        scene = colour_meshes(stage1)
    if not io.format_for(place.path, "Meshes", to=place.to).choices("image"):
        if any(mesh.opaque is not None for mesh in scene.meshes):
            holes = f"{place.path} has no texture for the holes of {source.name}"
            raise UsageError(f"{holes}; allowed: a format with textures")
        scene = Meshes(tuple(colour_vertices(mesh) for mesh in scene.meshes))
    worked = clock.worked
    reported = reporting(lambda: report(found) if report is not None else None)
    with reported, place.writing(steps, scene, **format_options) as written:
        judged_on = f"{FRAMES} pictures of {source.name}"
        loaded, quality = _judged(steps, place, written.path, held_out, judged_on, scene, format_options)
        counts = tuple(len(mesh.faces) for mesh in scene.meshes)
        found = MeshResult(place.path, str(loaded), written.size, counts, quality, worked)
        _tell_quality(steps, found, min_psnr)
    return found


def _tell_quality(steps: Steps, found: MeshResult, min_psnr: float | None) -> None:
    """Print the quality of a mesh. Raises BudgetMissed."""
    steps.say(f"{found.path}: {found.quality}; after {found.worked:.0f} CPU seconds")
    Budget(min_psnr=min_psnr).judge(found.quality.psnr, "the mesh has", found.quality.judged_on)


def mesh_target(target: AnyTarget | FolderTarget) -> Target | FolderTarget:
    """Return a path without an extension, or of a folder, as a FolderTarget; all others as a Target."""
    if isinstance(target, FolderTarget):
        return target
    given = as_target(target)
    path = given.path
    if path == io.STREAM or given.to is not None:
        return given
    folder = io.is_folder(path) or path.endswith("/") or not Path(path).suffix
    return FolderTarget(path, given.force) if folder else given


def require_mesh(
    place: Target | FolderTarget,
    options: MeshOptions = MeshOptions(),
    file: MeshFile = MeshFile(),
    *,
    inputs: Sequence[str | None] = (),
) -> dict[str, Any]:
    """Return the options of the output's format. Call it before doing any work.

    inputs: the paths that are read. Raises NerfbakeError if a mesh with these options cannot be written there.
    """
    options.require()
    if isinstance(place, FolderTarget):
        place.require("Stage1", inputs)
        given = [name for name, value in vars(file).items() if value]
        if given or len(options.triangles) > 1:
            names = ", ".join(f"`{name}`" for name in given) or "levels of detail"
            raise UsageError(f"{place.path} is a folder, for which {names} have no effect; allowed: with a file")
        return {}
    place.require_read_back("mesh")
    form = place.require("Meshes")
    format_options = file.options(form)
    if file.environment is not None and "reversible" not in format_options:
        raise UsageError(f"{form.suffix} stores no materials; allowed: a format that does, glTF")
    form.require_options(format_options)
    if len(options.triangles) > 1 and "quantised" not in format_options:
        raise UsageError(
            f"{form.suffix} stores one level of detail; allowed: one number of triangles, or another format"
        )
    return format_options


def build_mesh(
    steps: Steps,
    source: Source,
    field: RadianceField,
    views: Views,
    place: Target | FolderTarget,
    options: MeshOptions = MeshOptions(),
) -> Meshes | Stage1:
    """Return the mesh of a field with the appearance of these views, as the output stores it."""
    from nerfbake.stages.field_to_surface import build_surface
    from nerfbake.stages.mesh_to_mesh import simplify_surface
    from nerfbake.stages.surface_to_charts import unwrap_surface
    from nerfbake.stages.views_to_specular import fit_specular
    from nerfbake.stages.views_to_texture import fit_texture
    from nerfbake.stages.views_to_vertices import move_vertices

    with source.blamed(steps, "finding the surface"):
        box = None if options.box is None else world_box(options.box)
        triangles, largest = options.triangles[0], options.largest
        surface = build_surface(field, views.cameras, triangles=triangles, box=box, largest=largest)
    with source.blamed(steps, "moving vertices to the silhouettes"):
        surface = move_vertices(surface, views, rounds=_RIM_ROUNDS)
    levels, edge = [], options.texture
    for number, triangles in enumerate(options.triangles):
        of_level = f" of level {number}" if number else ""
        with source.blamed(steps, f"unwrapping the surface{of_level}"):
            mesh = simplify_surface(surface, triangles=triangles) if number else surface
            _tell_count(steps, place.path, len(mesh.faces), triangles)
            unwrapped = unwrap_surface(mesh, edge=edge)
        with source.blamed(steps, f"fitting texture and vertices in turns{of_level}"):
            for _ in progress.each(range(_TURNS)):
                # One ray a pixel and fewer texels take a quarter of the time, and the vertices are as good.
                coarse = fit_texture(unwrapped, views, edge=min(edge, _TURN_TEXTURE), samples=1)
                unwrapped = replace(move_vertices(coarse, views, rounds=_MOVES), texture=None)
        if isinstance(place, FolderTarget):
            with source.blamed(steps, "fitting texture and highlights"):
                return fit_specular(unwrapped, views, edge=edge, seed=options.seed)
        with source.blamed(steps, f"fitting the texture{of_level}"):
            level = fit_texture(unwrapped, views, edge=edge)
            textured = bool(io.format_for(place.path, "Meshes", to=place.to).choices("image"))
            levels.append(level if textured else colour_vertices(level))
        edge = max(edge // 2, min(edge, _LEAST_TEXTURE))
    return Meshes((levels[0],), tuple(levels[1:]))


def _read_light(steps: Steps, source: Source) -> EnvironmentMap:
    light: EnvironmentMap = source.read(steps, EnvironmentMap)
    with io.blame(source.name):
        light.require_light()
    return light


def _tell_count(steps: Steps, path: str, count: int, asked: int) -> None:
    """Print the number of triangles if it is not about the one that was asked for."""
    if not asked * (1 - _COUNTED) <= count <= asked * (1 + _COUNTED):
        why = "its surface has no more" if count < asked else "with fewer, its surface would fold"
        steps.say(f"{path}: has {count:,} triangles, not {asked:,}: {why}")


def _with_materials(
    steps: Steps, source: Source, scene: Meshes, views: Views, light: EnvironmentMap
) -> tuple[Meshes, tuple[Material, ...]]:
    """Return the levels of a mesh with materials, and the materials of the finest level."""
    from nerfbake.stages.views_and_light_to_materials import fit_materials

    with source.blamed(steps, "estimating materials"):
        levels = [
            fit_materials(each, views, light, edge=len(each.texture))
            for each in _levels(scene)
            if each.texture is not None
        ]
    return Meshes((levels[0].mesh,), tuple(each.mesh for each in levels[1:])), levels[0].clusters


def _lit(steps: Steps, source: Source, mesh: Mesh, held_out: Views, light: EnvironmentMap) -> tuple[float, ...]:
    """Return the PSNR in dB of a mesh with materials under the light, for each held-out view that shows it."""
    from nerfbake.stages.views_and_light_to_materials import light_pixels

    with source.blamed(steps, "lighting the held-out views"):
        return light_pixels(mesh, held_out, light, samples=SAMPLES)


def measure_mesh(scene: Meshes | Stage1, held_out: Views, *, judged_on: str) -> MeshQuality:
    """Measure a mesh on held-out views. judged_on: these views in words."""
    plain = Meshes(tuple(mesh for mesh in scene.meshes if mesh is not None))
    lit = isinstance(scene, Stage1)
    with progress.part(0, 0.9):
        views = measure_views(scene, held_out, samples=SAMPLES)
    diffuse = measure_views(plain, held_out, samples=SAMPLES) if lit else None
    return MeshQuality(views, diffuse, measure_silhouettes(plain, held_out), judged_on)


def _judged(
    steps: Steps,
    place: Target | FolderTarget,
    path: str,
    held_out: Views,
    judged_on: str,
    scene: Meshes | Stage1,
    format_options: dict[str, Any],
) -> tuple[Meshes | Stage1, MeshQuality]:
    """Read the written file or folder, and measure it on the held-out views.

    judged_on: these views in words. scene, format_options: what was written, and how.
    """
    judged_on += replace(held_out.cameras, samples=SAMPLES).rays_text
    with steps.phase(f"measuring on {len(held_out.pictures)} pictures"), io.blame(place.path):
        found: Meshes | Stage1
        if isinstance(place, FolderTarget):
            with read_back_as(place.path):
                found = io.load_folder(path, Stage1)
        else:
            found = read_back(place, path, scene, **format_options)
        return found, measure_mesh(found, held_out, judged_on=judged_on)


def _levels(scene: Meshes | Stage1) -> list[Mesh]:
    return [mesh for mesh in (*scene.meshes, *getattr(scene, "coarser", ())) if mesh is not None]
