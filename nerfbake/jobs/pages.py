"""Write interactive web pages of fields and meshes, or open temporary pages in the user's browser.

A page shows a field, a field with a mesh beside it, a mesh, a stage-1 folder of nerf2mesh, or an atlas baked from one.
"""

from __future__ import annotations

import os
import shutil
import sys
import tempfile
import webbrowser
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple, Unpack

from nerfbake import catalog, io, memory, progress
from nerfbake.errors import BudgetMissed, UsageError
from nerfbake.jobs.budgets import Budget, judge_output
from nerfbake.jobs.compressions import MAX_LOSS, CompressionGoal, GroundTruth
from nerfbake.jobs.devices import DEVICE, renderer_on
from nerfbake.jobs.files import AnySource, AnyTarget, Source, Target, as_source, as_target
from nerfbake.jobs.function_voxels import FunctionVoxels
from nerfbake.jobs.grids import GridChoice, tell_unused
from nerfbake.jobs.photographs import with_pictures
from nerfbake.jobs.pictures import PlacedMesh
from nerfbake.jobs.readings import FIELDS, Reading, upright_without
from nerfbake.jobs.steps import SILENT, Steps
from nerfbake.jobs.views import orbit_psnr, page_views
from nerfbake.kernels.arrays import Floats
from nerfbake.scene.atlas import BakedAtlas
from nerfbake.scene.camera import Camera, Cameras
from nerfbake.scene.compression import Compression
from nerfbake.scene.function_field import FunctionField
from nerfbake.scene.held_out import HeldOut
from nerfbake.scene.image import Image
from nerfbake.scene.lattice_field import LatticeField
from nerfbake.scene.mesh import Mesh, Meshes
from nerfbake.scene.n3tree import N3Tree
from nerfbake.scene.origin import lost_origin
from nerfbake.scene.page import Page, PageField
from nerfbake.scene.quantised_octree import QuantisedOctree
from nerfbake.scene.radiance_field import RadianceField
from nerfbake.scene.splats import Splats
from nerfbake.scene.stage1 import Stage1
from nerfbake.scene.volume import Volume
from nerfbake.stages.field_and_meshes_to_image import render_field_and_meshes
from nerfbake.stages.field_to_image import RenderOptions
from nerfbake.stages.field_to_page_field import build_page_field, round_field
from nerfbake.stages.meshes_to_image import render_meshes
from nerfbake.stages.n3tree_to_page_shells import build_page_shells
from nerfbake.stages.octree_to_compression import compress_octree
from nerfbake.stages.renderers import Renderer
from nerfbake.stages.scene_to_field import build_field, build_field_from_page, round_to_bytes
from nerfbake.stages.stage1_to_image import render_stage1
from nerfbake.stages.stage1_to_page_surface import build_page_surface

_ALLOWED = "an OUT, which you can open on another machine"


@contextmanager
def written_or_opened(target: AnyTarget | None) -> Iterator[Target]:
    """Yield the target of a page. Without one, yield a page in a temporary folder and open it after the block.

    The temporary folder is kept for the browser, unless the block fails. Raises UsageError, before the block runs, if
    no browser is available.
    """
    if target is not None:
        yield as_target(target)
        return
    _require_browser()
    folder = tempfile.mkdtemp(prefix="nerfbake-")
    page = Path(folder) / "page.html"
    try:
        yield Target(str(page))
    except BaseException:
        shutil.rmtree(folder, ignore_errors=True)
        raise
    if not webbrowser.open_new_tab(page.as_uri()):
        raise UsageError(f"no browser could open {page}; allowed: {_ALLOWED}")


def _require_browser() -> None:
    screen = sys.platform in ("darwin", "win32") or os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    if not screen and not os.environ.get("BROWSER"):
        raise UsageError(f"there is no display for a browser; allowed: {_ALLOWED}")
    try:
        webbrowser.get()
    except webbrowser.Error:
        raise UsageError(f"there is no browser; allowed: {_ALLOWED}") from None


_COPIES = 4  # copies of the triangles while a page is made: arrays, bytes, compressed, base64
Colour = tuple[float, float, float]


@dataclass(frozen=True, kw_only=True)
class PageLook:
    """Display options of a page. cameras: a capture to look from, or None. The others are those of Page."""

    title: str
    cameras: str | None
    background: Colour | None
    lookup: Literal["nearest", "trilinear"]


@dataclass(frozen=True, kw_only=True)
class PageExtras:
    """The meshes of a page beside its field, and their composite mode, as arguments of Page."""

    meshes: tuple[Mesh, ...] = ()
    composite: Literal["stop", "ztest"] = "stop"

    @staticmethod
    def of(steps: Steps, mesh: PlacedMesh | None) -> PageExtras:
        """Read the meshes of a file. Without a file there are no meshes. Raises NerfbakeError."""
        if mesh is None:
            return PageExtras()
        meshes = mesh.read(steps).meshes
        with io.blame(mesh.path):
            memory.require("the page's triangles and textures", _COPIES * memory.size_of(meshes))
        return PageExtras(meshes=meshes, composite=mesh.how)

    def render(self, field: RadianceField, view: Camera, render: Renderer, **options: Unpack[RenderOptions]) -> Image:
        """Render the first view of field and meshes. render: renders fields, and takes the options."""
        if not self.meshes:
            return render(field, view, **options)
        meshes = Meshes(self.meshes)
        return render_field_and_meshes(field, meshes, view, how=self.composite, render=render, **options)


def surface_page(
    steps: Steps, source: Source, scene: Stage1 | BakedAtlas | Meshes, stage1: str | None, look: PageLook
) -> Page:
    """Make the page of meshes, a stage-1 folder or an atlas. stage1: for an atlas, a folder whose MLP is also shown.

    Raises NerfbakeError.
    """
    mlp = None
    if stage1 is not None:
        with steps.phase(f"reading {stage1}"):
            mlp = io.load_folder(stage1, Stage1)
    if isinstance(scene, Meshes) and scene.origin.any():
        steps.say(f"{source.name}: {lost_origin(scene.origin, 'a page')}")
    with source.blamed(steps, "arranging the triangles"):
        surface = build_page_surface(scene, stage1=mlp)
    views, first = page_views(steps, scene, look.cameras, name=source.name)
    with source.blamed(steps, "rendering the cover"):
        render = render_meshes if isinstance(scene, Meshes) else render_stage1
        cover = render(scene, first, background=look.background)  # type: ignore[arg-type]
    return Page(surface, None, views, cover, look.title, turns=look.cameras is None, background=look.background)


_FRAMES, _EDGE = 4, 200  # number and edge of the pictures on which the loss of float16 is measured
# Limit for the compressed data of a page without a goal. The page is a third larger, since it stores them in base64,
# plus a quarter of a megabyte. A page of this size can be mailed.
_MOST_BYTES = 4_300_000

_PREVIEW = 480  # pixels along the longer edge of a photograph in a page

Data = Literal["compressed", "exact"]


def view_file(
    source: AnySource,
    target: AnyTarget | None = None,
    *,
    data: Data | None = None,
    goal: CompressionGoal = CompressionGoal(),
    choice: GridChoice = GridChoice(),
    functions: FunctionVoxels = FunctionVoxels(),
    cameras: str | None = None,
    photographs: bool = False,
    truth: str | None = None,
    min_psnr: float | None = None,
    samples: int | None = None,
    title: str | None = None,
    background: tuple[float, float, float] | None = None,
    lookup: Literal["nearest", "trilinear"] = "nearest",
    mesh: PlacedMesh | None = None,
    stage1: str | None = None,
    device: str = DEVICE,
    steps: Steps = SILENT,
) -> Page:
    """Write a page that shows a scene in any browser and return it. This is `nerfbake view`.

    The scene is a PlenOctree, an octree, a volume, a lattice, splats, a mesh, or a folder with a mesh: nerf2mesh's
    stage 1 or an atlas. The page of splats shows the octree that bake_octree() makes of them, with -y up unless there
    are cameras. Reads `source`, and the given cameras, photographs, mesh and stage-1 folder. Writes `target`, or
    `target`.rejected if min_psnr is missed. Without a target, writes a temporary page and opens it in the browser.

    data        compressed: the data of compress_file(); exact: float16; None: exact for a volume, else compressed
    goal        goal of the compression; max_size is the size of the page. By default a loss of 0.1 dB, or more if the
                page would take more than 6 MB. A source that is already compressed is carried unchanged if neither a
                goal nor truth is given
    choice      the grids of a volume
    functions   how a trained field becomes voxels
    cameras     a capture to look from, and to measure min_psnr on; None: the page opens with the front of the scene,
                and min_psnr is measured on 8 views around it
    photographs  also store the photographs of the cameras, at most 480 pixels wide and high, so that the page can show
                them over the scene
    truth       a folder with a photograph NAME.png for each of the cameras, to measure the loss of the compression on;
                None: it is predicted
    min_psnr    lowest allowed mean PSNR of the written page against `source`, in dB, without scenery; None: no limit
    samples     rays along each edge of a pixel of these pictures; None: from the cameras, else 1
    title       title of the page; None: the name of the source without its extension
    background  sRGB in 0..1; None: light or dark, following the browser's setting
    lookup      lookup that the page opens with, as in render_field(); it can be switched in the page
    mesh        a mesh to show in a field
    stage1      for an atlas: the stage-1 folder that it was baked from, whose MLP the page also shows
    device      what renders a field for the cover and for min_psnr, as in renderer_on()

    Raises NerfbakeError.

    >>> page = view_file("a.npz", "a.html", data="exact", title="A sample", min_psnr=60)
    >>> print(page)
    page of a SH1 page field of 573 rows, 2x2x2 cells of 8^3
    """
    source = as_source(source)
    ground_truth = GroundTruth(cameras=cameras, truth=truth, samples=samples)
    request = _Request(data=data, goal=goal, photographs=ground_truth)
    budget = Budget(min_psnr=min_psnr, cameras=cameras, samples=samples, device=device)
    request.photographs.require()
    if photographs and cameras is None:
        raise UsageError("`photographs` needs `cameras`, the capture that they are read from")
    if data == "exact" and request.anew:
        raise UsageError(
            "exact data are not compressed; allowed: `max_loss`, `max_size` and `truth` with `data=compressed`"
        )
    with written_or_opened(target) as file:
        form = file.require("Page")
        budget.require(file)
        read = _read(steps, source, request, choice, functions, judged=min_psnr is not None)
        if stage1 is not None and not isinstance(read.scene, BakedAtlas):
            raise UsageError(f"`stage1` needs an atlas, and {source.name} is not one; allowed: an atlas folder")
        look = PageLook(
            title=catalog.scene_name(source.name) if title is None else title,
            cameras=cameras,
            background=background,
            lookup=lookup,
        )
        if isinstance(read.scene, Stage1 | BakedAtlas | Meshes):
            if mesh or request.anew or photographs or min_psnr is not None:
                raise UsageError(
                    f"{source.name} contains triangles, for which a goal, `truth`, `photographs`, `min_psnr` and "
                    "`mesh` have no effect; allowed: these options with a field"
                )
            made = surface_page(steps, source, read.scene, stage1, look)
            file.write(steps, made)
            return made
        shown = _framed(steps, source, read, mesh, look, renderer_on(device, steps=steps), photographs=photographs)
        if data == "exact" or isinstance(read.scene, Volume):
            made = _exact(steps, source, shown)
        elif read.data is not None and not request.anew:
            steps.say(f"{source.name}: already compressed, so the page carries it unchanged")
            made = shown.page(form.load_page_module().script_readable(read.data))
        else:
            made = _compressed(steps, source, file, form, read, shown, request)
        with file.writing(steps, made) as written:
            judge_output(
                written.path,
                shown.field if read.judge is None else read.judge,
                budget,
                made_from=source.name,
                name=file.path,
                read=field_of_page,
                render=shown.render,
                steps=steps,
            )
    return made


@dataclass(frozen=True, kw_only=True)
class _Request:
    """The requested data of a page."""

    data: Data | None
    goal: CompressionGoal
    photographs: GroundTruth

    @property
    def anew(self) -> bool:
        """Whether a goal or photographs are given, so that a compressed source is compressed again."""
        return self.goal != CompressionGoal() or self.photographs.truth is not None


class _Shown(NamedTuple):
    """Everything in the page of a field except its content."""

    field: RadianceField
    views: Cameras
    cover: Image
    beside: PageExtras
    look: PageLook
    render: Renderer
    turns: bool
    around: tuple[PageField, ...]
    photographs: tuple[bytes, ...]

    def page(self, content: Any) -> Page:
        return Page(
            content,
            self.field,
            self.views,
            self.cover,
            self.look.title,
            turns=self.turns,
            background=self.look.background,
            lookup=self.look.lookup,
            meshes=self.beside.meshes,
            composite=self.beside.composite,
            around=self.around,
            photographs=self.photographs,
        )


class _Content(NamedTuple):
    """What was read.

    data      the bytes of an already compressed file
    scene     a PlenOctree that is going to be compressed, and splats, are octrees here; of a scene with scenery, this
              is the inner cube
    held_out  the pixels of photographs
    scenery   the whole scene, if it has scenery
    judge     what the page is compared with; None: the field of the scene
    origin    of the splats that the octree shows
    """

    data: memoryview | None
    scene: Any
    held_out: HeldOut | None = None
    scenery: N3Tree | None = None
    judge: Any = None
    origin: Floats | None = None


def _read(
    steps: Steps, source: Source, request: _Request, choice: GridChoice, functions: FunctionVoxels, *, judged: bool
) -> _Content:
    """Read the source. judged: keep what its voxels were made of."""
    standing = upright_without(request.photographs.cameras)
    kinds = *FIELDS, Meshes, Stage1, BakedAtlas
    reading = Reading(steps, source, *kinds, choice=choice, options=standing, functions=functions)
    reading.require()
    tell_unused(steps, source, reading.scene)
    if isinstance(reading.scene, Volume):
        if request.data == "compressed" or request.anew:
            raise UsageError(f"{source.name} is a volume, which cannot be compressed; allowed: `data=exact`")
        if request.data is None:
            steps.say(f"{source.name}: volumes are not compressed, so the page carries its values in float16")
    reading.use_inner_cube(keep=True)
    if isinstance(reading.scene, LatticeField | Splats) or (
        isinstance(reading.scene, N3Tree) and request.data != "exact"
    ):
        reading.octree()
    origin = reading.shown.origin if isinstance(reading.shown, Splats) else None
    judge = reading.shown if judged and isinstance(reading.shown, Splats | LatticeField | FunctionField) else None
    return _Content(reading.data, reading.scene, reading.held_out, reading.scenery, judge, origin)


def _framed(
    steps: Steps,
    source: Source,
    read: _Content,
    mesh: PlacedMesh | None,
    look: PageLook,
    render: Renderer,
    *,
    photographs: bool,
) -> _Shown:
    """Return the field of a scene with the cameras of the page, its cover picture and the shells around it.

    The page of a scene with scenery has the cameras of its held-out photographs, since no direction is up, and walls
    stand around it.
    """
    scenery = read.scenery
    held_out = scenery.held_out.cameras if scenery is not None and scenery.held_out is not None else None
    with source.blamed(steps, "building the field"):
        field = build_field(read.scene)
        whole = field if scenery is None else build_field(scenery)
        around = () if scenery is None else build_page_shells(scenery)
    views, first = page_views(steps, field, look.cameras, held_out, name=source.name, origin=read.origin)
    previews: tuple[bytes, ...] = ()
    if photographs:
        views, previews = read_previews(steps, str(look.cameras), views)
    beside = PageExtras.of(steps, mesh)
    with source.blamed(steps, "rendering the cover"):
        cover = beside.render(whole, first, render, background=look.background, lookup=look.lookup)
    turns = look.cameras is None and held_out is None
    return _Shown(field, views, cover, beside, look, render, turns, around, previews)


def read_previews(steps: Steps, path: str, views: Cameras) -> tuple[Cameras, tuple[bytes, ...]]:
    """Return the cameras of a capture that have a photograph, and each photograph as a small JPEG."""
    views, files = with_pictures(steps, path, views)
    with steps.phase(f"reading {len(files)} photographs"):
        cameras = progress.each(views.cameras)
        previews = (
            io.load_preview(file, _PREVIEW, (camera.width, camera.height))
            for file, camera in zip(files, cameras, strict=True)
        )
        return views, tuple(previews)


def _exact(steps: Steps, source: Source, shown: _Shown) -> Page:
    """Make the page of float16 values, and print the rounding error."""
    with source.blamed(steps, "arranging the field"):
        made = shown.page(build_page_field(shown.field))
    _tell_rounding(steps, source, shown.field)
    return made


def _compressed(
    steps: Steps, source: Source, file: Target, form: catalog.Format, read: _Content, shown: _Shown, request: _Request
) -> Page:
    """Make the page of compressed data, and print their size and loss."""
    found = _compression(steps, source, read, shown, request, form)
    steps.say(f"{file.name}: {found}")
    if request.goal == CompressionGoal() and found.loss > MAX_LOSS:
        most = f"the compressed data are limited to {_MOST_BYTES / 1e6:g} MB by default"
        steps.say(f"{file.name}: {most}; `max_loss={MAX_LOSS:g}` makes a larger page")
    return shown.page(found.quantised)


def _compression(
    steps: Steps, source: Source, read: _Content, shown: _Shown, request: _Request, form: catalog.Format
) -> Compression:
    """Compress an octree to the requested goal. max_size is the size of the page."""
    sized = form if request.goal.max_size is not None else catalog.formats_of("QuantisedOctree")[0]
    module = sized.load_packed_module()

    def coded_size(quantised: QuantisedOctree) -> int:
        return module.coded_size(shown.page(quantised) if sized is form else quantised)

    options = request.goal.options | request.photographs.read(steps, read.held_out)
    with source.blamed(steps, "compressing") as tell:
        options |= {"coded_size": coded_size, "field": shown.field, "tell": tell, "render": shown.render}
        most = _MOST_BYTES - _shells_size(shown, form)
        if request.goal == CompressionGoal() and most > 0:
            with suppress(BudgetMissed):  # the octree has too many leaves to fit at any precision
                return compress_octree(read.scene, max_size=most, **options)
        return compress_octree(read.scene, **options)


def _shells_size(shown: _Shown, form: catalog.Format) -> int:
    """Return the size in bytes of the shells around a scene, without the base64 of the page."""
    if not shown.around:
        return 0
    size = form.load_packed_module().coded_size
    return 3 * (size(shown.page(b"")) - size(shown._replace(around=()).page(b""))) // 4


def field_of_page(path: str) -> RadianceField:
    """Read the field of a written page, with the values that its shader gets."""
    content = io.load_page_content(path)
    if isinstance(content, PageField):
        return build_field_from_page(content)
    return round_to_bytes(round_field(build_field(content)))


def _tell_rounding(steps: Steps, source: Source, field: RadianceField) -> None:
    """Print the PSNR of the float16 values, unless the rounding is exact."""
    with source.blamed(steps, "measuring the rounding error"):
        rounded = round_field(field)
        if (rounded.values == field.values).all():
            return
        decibels = orbit_psnr(field, rounded, _FRAMES, _EDGE)
    steps.say(f"{source.name}: float16 gives {decibels:.2f} dB against its float32")
