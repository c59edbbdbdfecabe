"""Two files seen by the same cameras: how far they are apart, as figures, a sheet of pictures and a page."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import nerfbake
from nerfbake import io
from nerfbake.errors import UsageError
from nerfbake.jobs.budgets import EDGE, FRAMES
from nerfbake.jobs.files import AnySource, Source, as_source
from nerfbake.jobs.steps import SILENT, Steps
from nerfbake.jobs.views import shown, views_of


class Seen(NamedTuple):
    """Whose views are compared.

    cameras  a capture; None: 8 views around the first scene
    truth    a folder with a photograph, NAME.png, for each of the cameras; None: there are none
    size     (W, H) pixels; None: the truth's or the cameras', 400 x 400 for an orbit
    samples  rays along each edge of a pixel; None: as the cameras have it, or 1
    """

    cameras: str | None = None
    truth: str | None = None
    size: tuple[int, int] | None = None
    samples: int | None = None


class Limits(NamedTuple):
    """How far the second scene may be off: its mean PSNR in dB, and a pixel's channel in 0..1; None: any distance."""

    min_psnr: float | None = None
    max_error: float | None = None


class Pages(NamedTuple):
    """What is written of a comparison: a .png of all its pictures, a .html page with everything; None: neither."""

    sheet: str | None = None
    html: str | None = None
    force: bool = False

    def __bool__(self) -> bool:
        return bool(self.sheet or self.html)

    def require(self) -> None:
        """Raises, before any work is done, if one of them could not be written."""
        for target, kind in ((self.sheet, "Image"), (self.html, "Comparison")):
            if target == io.STREAM:
                raise UsageError("stdout has the figures; allowed for `sheet` and `html`: a file")
            if target:
                io.format_for(target, kind)
                io.require_absent(target, force=self.force)


AROUND, NO_LIMITS, NO_PAGES = Seen(), Limits(), Pages()


class Compared(NamedTuple):
    """a, b: the two files' name, content, format and bytes; found: how far they are apart."""

    a: dict[str, Any]
    b: dict[str, Any]
    found: nerfbake.Comparison


def compare_files(
    a: AnySource,
    b: AnySource,
    *,
    seen: Seen = AROUND,
    limits: Limits = NO_LIMITS,
    pages: Pages = NO_PAGES,
    steps: Steps = SILENT,
    report: Callable[[Compared], None] | None = None,
) -> Compared:
    """Renders the scenes in two files or folders with the same cameras: how far they are apart; `nerfbake compare`.

    Reads `a`, `b`, and the cameras and photographs of `seen`; writes `pages`. report gets what is returned as soon as
    all is written, before it is judged. Raises NerfbakeError; BudgetMissed, exit code 3, where `b` is further off than
    the limits allow.

    >>> compared = compare_files("a.npz", "a.npz", seen=Seen(size=(32, 32)), limits=Limits(min_psnr=90))
    >>> compared.found.means["a_b"]["psnr"]
    100.0
    """
    pages.require()
    first, second = as_source(a), as_source(b)
    (scene, facts), (other, others) = (_read(steps, each) for each in (first, second))
    scene = shown(steps, scene, first.name)
    views = views_of(
        steps, scene, seen.cameras, name=first.name, frames=FRAMES, edge=EDGE, size=seen.size, samples=seen.samples
    )
    photographs = list(io.Truth(seen.truth, views.names, nerfbake.Image)) if seen.truth else None
    if photographs and not seen.size:
        views = views.fitting(photographs)
    with second.blamed(steps, f"rendering {2 * len(views.cameras)} pictures"):
        if pages:
            views.require_memory(pictures=6 if photographs else 4)
        found = nerfbake.compare_scenes(scene, other, views, truth=photographs, keep_pictures=bool(pages))
    if pages.sheet:
        io.save(pages.sheet, found.sheet, force=pages.force)
    if pages.html:
        io.save(pages.html, found, force=pages.force, a=facts, b=others, **limits._asdict())
    compared = Compared(facts, others, found)
    if report is not None:
        report(compared)
    with second.blamed(steps, "judging"):
        found.require(**limits._asdict())
    return compared


def _read(steps: Steps, source: Source) -> tuple[Any, dict[str, Any]]:
    """The scene, and what a reader wants to know of it."""
    fields = nerfbake.N3Tree, nerfbake.SparseVoxelOctree, nerfbake.Volume, nerfbake.LatticeField
    kinds = *fields, nerfbake.Meshes, nerfbake.Stage1, nerfbake.BakedAtlas
    found = source.read_with_format(steps, *kinds)
    facts = {"name": source.name, "content": str(found.scene), "format": found.form.name, "bytes": found.size}
    return found.scene, facts
