"""Compare two files with the same cameras: figures, a sheet of pictures and an HTML page."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

from nerfbake import io
from nerfbake.errors import UsageError
from nerfbake.jobs.budgets import EDGE, FRAMES
from nerfbake.jobs.devices import DEVICE, renderer_on
from nerfbake.jobs.files import AnySource, Source, as_source
from nerfbake.jobs.function_voxels import FunctionVoxels, World
from nerfbake.jobs.grids import tell_unused
from nerfbake.jobs.steps import SILENT, Steps
from nerfbake.jobs.views import in_one_world, renderable_scene, views_of
from nerfbake.scene.atlas import BakedAtlas
from nerfbake.scene.comparison import Comparison
from nerfbake.scene.function_field import FunctionField
from nerfbake.scene.image import Image
from nerfbake.scene.lattice_field import LatticeField
from nerfbake.scene.mesh import Meshes
from nerfbake.scene.n3tree import N3Tree
from nerfbake.scene.octree import SparseVoxelOctree
from nerfbake.scene.splats import Splats
from nerfbake.scene.stage1 import Stage1
from nerfbake.scene.volume import Volume
from nerfbake.stages.scenes_to_comparison import compare_scenes


@dataclass(frozen=True, kw_only=True)
class ComparedViews:
    """The views that are compared.

    cameras  a capture; None: 8 views around the first scene, or 8 of those that a trained field has
    truth    a folder with a photograph NAME.png for each of the cameras; None: no photographs
    size     (W, H) pixels; None: that of the photographs or cameras, 400 x 400 for an orbit
    samples  rays along each edge of a pixel; None: from the cameras, else 1
    world    of trained fields: that of the user's cameras, or that of the network
    device   what renders fields and splats, as in renderer_on()
    """

    cameras: str | None = None
    truth: str | None = None
    size: tuple[int, int] | None = None
    samples: int | None = None
    world: World = "original"
    device: str = DEVICE


@dataclass(frozen=True, kw_only=True)
class ComparisonLimits:
    """Limits: the lowest mean PSNR in dB, and the largest difference of a channel in 0..1. None: no limit."""

    min_psnr: float | None = None
    max_error: float | None = None


@dataclass(frozen=True, kw_only=True)
class ComparisonOutputs:
    """Files to write: sheet, a .png with all pictures; html, a page with all results. None: do not write it."""

    sheet: str | None = None
    html: str | None = None
    force: bool = False

    def __bool__(self) -> bool:
        return bool(self.sheet or self.html)

    def require(self) -> None:
        """Raise NerfbakeError if one of the files could not be written. Call it before doing any work."""
        for target, kind in ((self.sheet, "Image"), (self.html, "Comparison")):
            if target == io.STREAM:
                raise UsageError("`sheet` and `html` cannot be stdout, which gets the figures; allowed: a file")
            if target:
                io.format_for(target, kind)
                io.require_absent(target, force=self.force)


class FileComparison(NamedTuple):
    """a, b: name, content, format and bytes of each file. found: the differences between them."""

    a: dict[str, Any]
    b: dict[str, Any]
    found: Comparison


def compare_files(
    a: AnySource,
    b: AnySource,
    *,
    seen: ComparedViews = ComparedViews(),
    limits: ComparisonLimits = ComparisonLimits(),
    pages: ComparisonOutputs = ComparisonOutputs(),
    steps: Steps = SILENT,
    report: Callable[[FileComparison], None] | None = None,
) -> FileComparison:
    """Render two files or folders with the same cameras and return their differences. This is `nerfbake compare`.

    Reads `a`, `b`, and the cameras and photographs of `seen`; writes `pages`. report is called with the result once the
    pages are written, before the limits are checked. Raises NerfbakeError; BudgetMissed (exit code 3) if the difference
    exceeds the limits.

    >>> views, limits = ComparedViews(size=(32, 32)), ComparisonLimits(min_psnr=90)
    >>> compared = compare_files("a.npz", "a.npz", seen=views, limits=limits)
    >>> compared.found.means["a_b"]["psnr"]
    100.0
    """
    pages.require()
    render = renderer_on(seen.device, steps=steps)
    first, second = as_source(a), as_source(b)
    if first.path == second.path == io.STREAM:
        raise UsageError("both scenes are stdin, which can be read once; allowed: '-' for one of them")
    (scene, facts), (other, others) = (_read(steps, each, seen.world) for each in (first, second))
    if seen.world != "original" and not any(isinstance(each, FunctionField) for each in (scene, other)):
        raise UsageError("`world` has no effect on these scenes; allowed: with a trained field")
    scene, other = in_one_world(steps, [(first.name, scene), (second.name, other)])
    scene = renderable_scene(steps, scene, first.name)
    views = views_of(
        steps,
        scene,
        seen.cameras,
        name=first.name,
        frames=FRAMES,
        edge=EDGE,
        size=seen.size,
        samples=seen.samples,
        own=True,
    )
    photographs = list(io.Truth(seen.truth, views.names, Image)) if seen.truth else None
    with io.blame(seen.cameras or first.name):
        if photographs and not seen.size:
            views = views.fitting(photographs)
        views.require_covered()
    with second.blamed(steps, f"rendering {2 * len(views.cameras)} pictures"):
        if pages:
            views.require_memory(pictures=6 if photographs else 4)
        found = compare_scenes(scene, other, views, truth=photographs, keep_pictures=bool(pages), render=render)
    if pages.sheet:
        io.save(pages.sheet, found.sheet, force=pages.force)
    if pages.html:
        io.save(pages.html, found, force=pages.force, a=facts, b=others, **vars(limits))
    io.report_result(psnr=float(found.means["a_b"]["psnr"]))
    compared = FileComparison(facts, others, found)
    if report is not None:
        report(compared)
    with second.blamed(steps, "checking the limits"):
        found.require(**vars(limits))
    return compared


def _read(steps: Steps, source: Source, world: World) -> tuple[Any, dict[str, Any]]:
    """Return the scene, and its name, content, format and size in bytes."""
    fields = N3Tree, SparseVoxelOctree, Volume, LatticeField, FunctionField
    kinds = *fields, Splats, Meshes, Stage1, BakedAtlas
    found = source.read_with_format(steps, *kinds)
    tell_unused(steps, source, found.scene)
    facts = {"name": source.name, "content": str(found.scene), "format": found.form.name, "bytes": found.size}
    scene = found.scene
    return FunctionVoxels(world=world).placed(scene) if isinstance(scene, FunctionField) else scene, facts
