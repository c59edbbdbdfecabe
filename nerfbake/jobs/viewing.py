"""Pages to look around in, from files to files."""

from __future__ import annotations

from pathlib import PurePath
from typing import Any, Literal

import nerfbake
from nerfbake import catalog
from nerfbake.errors import UsageError
from nerfbake.jobs.compressions import LEAST_LOSS, SOURCE_PSNR, Goal
from nerfbake.jobs.files import AnySource, AnyTarget, Source, as_source, as_target
from nerfbake.jobs.octrees import read_octree
from nerfbake.jobs.steps import SILENT, Steps
from nerfbake.jobs.views import views_of

COVER = 320  # pixels along an edge of the picture that is there at once
_FRAMES, _EDGE = 4, 200  # of the pictures that tell what float16 loses

Data = Literal["compressed", "exact"]


def view_file(
    source: AnySource,
    target: AnyTarget,
    *,
    data: Data = "compressed",
    goal: Goal = LEAST_LOSS,
    title: str | None = None,
    background: tuple[float, float, float] | None = None,
    cameras: str | None = None,
    steps: Steps = SILENT,
) -> nerfbake.Page:
    """Writes a page that shows a PlenOctree or an octree in any browser, and gives what it shows; `nerfbake view`.

    Reads `source`, and the cameras if they are named; writes `target`. data: compressed, as compress_file() does it, to
    a goal whose max_size is that of the page; exact, float16. title: None for the name of the source. background: sRGB
    in 0..1; None: the reader's own. cameras: a capture to look from; None: the page opens with the front of the scene,
    which turns slowly. Raises NerfbakeError.

    >>> page = view_file("a.npz", "a.html", data="exact", title="A sample")
    >>> print(page)
    page of a SH9 page field of 1,252 rows, 2x2x2 cells of 8^3
    """
    source, target = as_source(source), as_target(target)
    if data == "exact" and goal != LEAST_LOSS:
        raise UsageError("exact data have no goal; allowed: --max-loss and --max-size with --data compressed")
    options = goal.options
    title = title if title is not None else PurePath(source.name).name
    form = target.require("Page")
    if data == "exact":
        scene = source.read(steps, nerfbake.N3Tree, nerfbake.SparseVoxelOctree)
    else:
        scene = read_octree(steps, source)
    with source.blamed(steps, "building the field"):
        field = nerfbake.build_field(scene)
    with source.blamed(steps, "arranging the field"):
        content = nerfbake.build_page_field(field) if data == "exact" else None
    views = views_of(steps, field, cameras, name=source.name, frames=1, edge=COVER)
    with source.blamed(steps, "rendering the cover"):
        cover = nerfbake.render_field(field, _square(views.cameras[0]), background=background)

    def page(content: Any) -> nerfbake.Page:
        return nerfbake.Page(content, field, views, cover, title, turns=cameras is None, background=background)

    if content is not None:
        _tell_rounding(steps, source, field)
        made = page(content)
    else:
        packed = (
            form.load_packed_module()
            if goal.max_size
            else catalog.formats_of("QuantisedOctree")[0].load_packed_module()
        )

        def coded_size(quantised: nerfbake.QuantisedOctree) -> int:
            return packed.coded_size(page(quantised)) if goal.max_size else packed.coded_size(quantised)

        with source.blamed(steps, "compressing") as tell:
            found = nerfbake.compress_octree(
                scene, coded_size=coded_size, source_psnr=SOURCE_PSNR, tell=tell, **options
            )
        steps.say(f"{target.path}: {found}")
        made = page(found.quantised)
    target.write(steps, made)
    return made


def _square(camera: nerfbake.Camera) -> nerfbake.Camera:
    """A page's first picture, of the camera's shorter edge."""
    focal = camera.fx * COVER / min(camera.width, camera.height)
    return nerfbake.Camera(COVER, COVER, focal, camera.pose, camera.name)


def _tell_rounding(steps: Steps, source: Source, field: nerfbake.RadianceField) -> None:
    """Says what float16 loses of values that it does not hold."""
    with source.blamed(steps, "measuring what float16 loses"):
        rounded = nerfbake.round_field(field)
        if (rounded.values == field.values).all():
            return
        views = nerfbake.orbit_cameras(field, frames=_FRAMES, width=_EDGE, height=_EDGE)
        found = nerfbake.compare_scenes(field, rounded, views, keep_pictures=False)
    steps.say(f"{source.name}: float16 is {found.means['a_b']['psnr']:.2f} dB from its float32")
