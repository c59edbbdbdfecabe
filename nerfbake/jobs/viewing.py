"""Pages to look around in, from files to files."""

from __future__ import annotations

from contextlib import suppress
from typing import Any, Literal, NamedTuple

import nerfbake
from nerfbake import catalog, io
from nerfbake.errors import BudgetMissed, UsageError
from nerfbake.jobs.browsers import written_or_opened
from nerfbake.jobs.budgets import Budget, judge
from nerfbake.jobs.compressions import LEAST_LOSS, MAX_LOSS, Goal, Photographs
from nerfbake.jobs.files import AnySource, AnyTarget, Source, as_source
from nerfbake.jobs.grids import AS_IT_IS, Choice
from nerfbake.jobs.lattices import octree_of
from nerfbake.jobs.pictures import PlacedMesh
from nerfbake.jobs.steps import SILENT, Steps
from nerfbake.jobs.surfaces import Beside, Look, surface_page
from nerfbake.jobs.views import page_views

_FRAMES, _EDGE = 4, 200  # of the pictures that tell what float16 loses
# Of the compressed data of a page that has no goal of its own. The page is a third larger, as it spells them in base64,
# and a quarter of a megabyte: it can be mailed.
_MOST_BYTES = 4_300_000

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
    goal        of the compression; its max_size is that of the page. By default a loss of 0.1 dB, or more where the
                page would take more than 6 MB. What is compressed already is carried as it is, where neither a goal
                nor truth is named
    choice      which grids of a volume
    cameras     a capture to look from, and to judge by; None: the page opens with the front of the scene, which turns
                slowly, and 8 views around it judge
    truth       a folder with a photograph, NAME.png, for each of the cameras, against which the compression's loss is
                measured; None: it is predicted
    min_psnr    the least mean PSNR in dB of what the written page shows, against `source`; None: any
    samples     rays along each edge of a pixel of these pictures; None: as the cameras have it, or 1
    title       None: the name of the source without its ending
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
    photographs, budget = Photographs(cameras, truth, samples=samples), Budget(min_psnr, cameras, samples)
    wish = _Wish(data, goal, photographs, anew=goal != LEAST_LOSS or truth is not None)
    photographs.require()
    if data == "exact" and wish.anew:
        raise UsageError("exact data have no goal; allowed: `max_loss`, `max_size` and `truth` with `data=compressed`")
    with written_or_opened(target) as file:
        form = file.require("Page")
        budget.require(file)
        content, scene, held_out = _read(steps, source, wish, choice)
        if stage1 is not None and not isinstance(scene, nerfbake.BakedAtlas):
            raise UsageError(f"`stage1` goes with an atlas, which {source.name} is not; allowed: an atlas folder")
        look = Look(catalog.scene_name(source.name) if title is None else title, cameras, background, lookup)
        if isinstance(scene, nerfbake.Stage1 | nerfbake.BakedAtlas):
            if mesh or wish.anew or min_psnr is not None:
                raise UsageError(
                    f"{source.name} holds triangles, which have no goal, no judge, and no mesh beside them; "
                    "allowed: these options with a field"
                )
            made = surface_page(steps, source, scene, stage1, look)
            file.write(steps, made)
            return made
        shown = _framed(steps, source, scene, mesh, look)
        if data == "exact" or isinstance(scene, nerfbake.Volume):
            made = _exact(steps, source, shown)
        elif content is not None and not wish.anew:
            steps.say(f"{source.name}: it is compressed already, so that the page carries it as it is")
            made = shown.page(form.load_page_module().carried(content))
        else:
            found = _compressed(steps, source, scene, held_out, shown, wish, form)
            steps.say(f"{file.path}: {found}")
            if goal == LEAST_LOSS and found.loss > MAX_LOSS:
                most = f"has {_MOST_BYTES / 1e6:g} MB of compressed data at most, unless you say otherwise"
                steps.say(f"{file.path}: {most}; `max_loss={MAX_LOSS:g}` takes more")
            made = shown.page(found.quantised)
        with file.writing(steps, made) as written:
            judge(written.path, shown.field, budget, made_from=source.name, name=file.path, read=_field_of, steps=steps)
    return made


class _Wish(NamedTuple):
    """What a page is to carry: goals as compress_octree() takes them; anew: somebody named one, so that what is
    compressed already is compressed again."""

    data: Data | None
    goal: Goal
    photographs: Photographs
    anew: bool


class _Shown(NamedTuple):
    """All that a page of a field has beside its content."""

    field: nerfbake.RadianceField
    views: nerfbake.Cameras
    cover: nerfbake.Image
    beside: Beside
    look: Look

    def page(self, content: Any) -> nerfbake.Page:
        title, cameras, background, lookup = self.look
        turns = cameras is None
        return nerfbake.Page(
            content, self.field, self.views, self.cover, title, turns, background, lookup, *self.beside
        )


def _read(
    steps: Steps, source: Source, wish: _Wish, choice: Choice
) -> tuple[memoryview | None, Any, nerfbake.HeldOut | None]:
    """The content of a file that is compressed already, the scene as it is shown (an octree, where it is to be
    compressed), and the pixels of photographs that it has."""
    fields = nerfbake.N3Tree, nerfbake.SparseVoxelOctree, nerfbake.Volume, nerfbake.LatticeField
    read = source.read_with_format(steps, *fields, nerfbake.Stage1, nerfbake.BakedAtlas)
    scene = octree_of(steps, source, read.scene) if isinstance(read.scene, nerfbake.LatticeField) else read.scene
    scene = choice.of(steps, source, scene)
    if isinstance(scene, nerfbake.Volume):
        if wish.data == "compressed" or wish.anew:
            raise UsageError(f"{source.name} is a volume, which is not compressed; allowed: `data=exact`")
        if wish.data is None:
            steps.say(f"{source.name}: a volume is not compressed, so that the page carries it as it is, in float16")
    elif wish.data != "exact" and isinstance(scene, nerfbake.N3Tree):
        with source.blamed(steps, "building the octree"):
            return None, nerfbake.build_octree(scene), scene.held_out
    return read.data, scene, None


def _framed(steps: Steps, source: Source, scene: Any, mesh: PlacedMesh | None, look: Look) -> _Shown:
    """A scene's field, from where it is looked at, and what is seen of it at once."""
    with source.blamed(steps, "building the field"):
        field = nerfbake.build_field(scene)
    views, first = page_views(steps, field, look.cameras, name=source.name)
    with source.blamed(steps, "rendering the cover"):
        beside = Beside.of(mesh)
        cover = beside.render(field, first, background=look.background, lookup=look.lookup)
    return _Shown(field, views, cover, beside, look)


def _exact(steps: Steps, source: Source, shown: _Shown) -> nerfbake.Page:
    """The page of float16 values; says what they lose."""
    with source.blamed(steps, "arranging the field"):
        made = shown.page(nerfbake.build_page_field(shown.field))
    _tell_rounding(steps, source, shown.field)
    return made


def _compressed(
    steps: Steps,
    source: Source,
    octree: nerfbake.SparseVoxelOctree,
    held_out: nerfbake.HeldOut | None,
    shown: _Shown,
    wish: _Wish,
    form: catalog.Format,
) -> nerfbake.Compression:
    """An octree, compressed to its goals: max_size is the page's."""
    sized = form if wish.goal.max_size is not None else catalog.formats_of("QuantisedOctree")[0]
    module = sized.load_packed_module()

    def coded_size(quantised: nerfbake.QuantisedOctree) -> int:
        return module.coded_size(shown.page(quantised) if sized is form else quantised)

    options = wish.goal.options | wish.photographs.read(steps, held_out)
    with source.blamed(steps, "compressing") as tell:
        options |= {"coded_size": coded_size, "field": shown.field, "tell": tell}
        if wish.goal == LEAST_LOSS:
            with suppress(BudgetMissed):  # there are so many leaves that they do not fit, however coarse they are
                return nerfbake.compress_octree(octree, max_size=_MOST_BYTES, **options)
        return nerfbake.compress_octree(octree, **options)


def _field_of(path: str) -> nerfbake.RadianceField:
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
