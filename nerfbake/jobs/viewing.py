"""Pages to look around in, from files to files."""

from __future__ import annotations

from pathlib import PurePath
from typing import Any, Literal

import nerfbake
from nerfbake import catalog, io
from nerfbake.errors import UsageError
from nerfbake.jobs.browsers import written_or_opened
from nerfbake.jobs.budgets import Budget, judge
from nerfbake.jobs.compressions import LEAST_LOSS, Goal, Photographs
from nerfbake.jobs.files import AnySource, AnyTarget, Source, as_source
from nerfbake.jobs.grids import AS_IT_IS, Choice
from nerfbake.jobs.lattices import octree_of
from nerfbake.jobs.pictures import PlacedMesh
from nerfbake.jobs.steps import SILENT, Steps
from nerfbake.jobs.surfaces import Beside, Look, surface_page
from nerfbake.jobs.views import COVER, cover_view, views_of

_FRAMES, _EDGE = 4, 200  # of the pictures that tell what float16 loses

Data = Literal["compressed", "exact"]


def view_file(
    source: AnySource,
    target: AnyTarget | None = None,
    *,
    data: Data | None = None,
    goal: Goal = LEAST_LOSS,
    choice: Choice = AS_IT_IS,
    cameras: str | None = None,
    truth: str | None = None,
    min_psnr: float | None = None,
    samples: int | None = None,
    title: str | None = None,
    background: tuple[float, float, float] | None = None,
    lookup: Literal["nearest", "trilinear"] = "nearest",
    mesh: PlacedMesh | None = None,
    stage1: str | None = None,
    steps: Steps = SILENT,
) -> nerfbake.Page:
    """Writes a page that shows a scene in any browser, and gives what it shows; `nerfbake view`.

    The scene is a PlenOctree, an octree, a volume, a lattice field, or a folder with its mesh: nerf2mesh's stage 1, or
    an atlas. Reads `source`, and the cameras, the photographs, the mesh and the stage 1 that are named; writes
    `target`, or `target`.rejected where min_psnr is missed. Without a target the page is a temporary one, opened in the
    reader's browser.

    data        compressed, as compress_file() does it; exact, float16; None: exact for a volume, else compressed
    goal        of the compression; its max_size is that of the page
    choice      which grids of a volume
    cameras     a capture to look from, and to judge by; None: the page opens with the front of the scene, which turns
                slowly, and 8 views around it judge
    truth       a folder with a photograph, NAME.png, for each of the cameras, against which the compression's loss is
                measured; None: it is predicted
    min_psnr    the least mean PSNR in dB of what the written page shows, against `source`; None: any
    samples     rays along each edge of a pixel of these pictures; None: as the cameras have it, or 1
    title       None: the name of the source
    background  sRGB in 0..1; None: the reader's own, light or dark
    lookup      how the page opens, as render_field() has it; its reader may change it
    mesh        triangles that stand in a field
    stage1      of an atlas the stage-1 folder that it was baked from, whose MLP the page shows, too

    Raises NerfbakeError.

    >>> page = view_file("a.npz", "a.html", data="exact", title="A sample", min_psnr=60)
    >>> print(page)
    page of a SH1 page field of 1,252 rows, 2x2x2 cells of 8^3
    """
    source = as_source(source)
    goals, photographs, budget = (
        goal.options,
        Photographs(cameras, truth, samples=samples),
        Budget(min_psnr, cameras, samples),
    )
    photographs.require()
    packed = goal != LEAST_LOSS or truth is not None
    if data == "exact" and packed:
        raise UsageError("exact data have no goal; allowed: --max-loss, --max-size and --truth with --data compressed")
    with written_or_opened(target) as file:
        form = file.require("Page")
        budget.require(file)
        scene = _read(steps, source, data, choice, packed=packed)
        called = title if title is not None else PurePath(source.name).name
        if isinstance(scene, nerfbake.Stage1 | nerfbake.BakedAtlas):
            if mesh or packed or min_psnr is not None:
                raise UsageError(
                    f"{source.name} holds triangles, which have no goal, no judge, and no mesh beside them; "
                    "allowed: these options with a field"
                )
            made = surface_page(steps, source, scene, stage1, Look(called, cameras, background))
            file.write(steps, made)
            return made
        if stage1 is not None:
            raise UsageError(f"--stage1 goes with an atlas, and {source.name} holds none; allowed: an atlas folder")
        with source.blamed(steps, "building the field"):
            field = nerfbake.build_field(scene)
        views = views_of(steps, field, cameras, name=source.name, frames=1, edge=COVER)
        with source.blamed(steps, "rendering the cover"):
            beside = Beside.of(mesh)
            cover = beside.render(field, cover_view(views.cameras[0]), background=background, lookup=lookup)

        def page(content: Any) -> nerfbake.Page:
            turns = cameras is None
            return nerfbake.Page(content, field, views, cover, called, turns, background, lookup, *beside)

        if data == "exact" or isinstance(scene, nerfbake.Volume):
            with source.blamed(steps, "arranging the field"):
                made = page(nerfbake.build_page_field(field))
            _tell_rounding(steps, source, field)
        else:
            goals |= photographs.read(steps)
            module = (form if goal.max_size else catalog.formats_of("QuantisedOctree")[0]).load_packed_module()

            def coded_size(quantised: nerfbake.QuantisedOctree) -> int:
                return module.coded_size(page(quantised) if goal.max_size else quantised)

            with source.blamed(steps, "compressing") as tell:
                found = nerfbake.compress_octree(scene, coded_size=coded_size, tell=tell, **goals)
            steps.say(f"{file.path}: {found}")
            made = page(found.quantised)
        file.write(steps, made)
        judge(file.path, field, budget, made_from=source.name, read=_shown, steps=steps)
    return made


def _read(steps: Steps, source: Source, data: Data | None, choice: Choice, *, packed: bool) -> Any:
    """The scene: an octree, where it is to be compressed."""
    fields = nerfbake.N3Tree, nerfbake.SparseVoxelOctree, nerfbake.Volume, nerfbake.LatticeField
    read = source.read(steps, *fields, nerfbake.Stage1, nerfbake.BakedAtlas)
    if isinstance(read, nerfbake.LatticeField):
        read = octree_of(steps, source, read)
    scene = choice.of(steps, source, read)
    if isinstance(scene, nerfbake.Volume):
        if data == "compressed" or packed:
            raise UsageError(f"{source.name} is a volume, which is not compressed; allowed: --data exact")
        if data is None:
            steps.say(f"{source.name}: a volume is not compressed, so that the page carries it as it is, in float16")
    elif data != "exact" and isinstance(scene, nerfbake.N3Tree):
        with source.blamed(steps, "building the octree"):
            return nerfbake.build_octree(scene)
    return scene


def _shown(path: str) -> nerfbake.RadianceField:
    """What the page in a file shows: the values that its shader reads."""
    content = io.load_page_content(path)
    if isinstance(content, nerfbake.PageField):
        return nerfbake.field_of_page_field(content)
    return nerfbake.round_to_bytes(nerfbake.round_field(nerfbake.build_field(content)))


def _tell_rounding(steps: Steps, source: Source, field: nerfbake.RadianceField) -> None:
    """Says what float16 loses of values that it does not hold."""
    with source.blamed(steps, "measuring what float16 loses"):
        rounded = nerfbake.round_field(field)
        if (rounded.values == field.values).all():
            return
        views = nerfbake.orbit_cameras(field, frames=_FRAMES, width=_EDGE, height=_EDGE)
        found = nerfbake.compare_scenes(field, rounded, views, keep_pictures=False)
    steps.say(f"{source.name}: float16 is {found.means['a_b']['psnr']:.2f} dB from its float32")
