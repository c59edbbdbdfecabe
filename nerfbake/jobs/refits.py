"""An octree that looks like a finer scene, or like photographs, without a node more."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any, NamedTuple

import nerfbake
from nerfbake import io, progress
from nerfbake.errors import UsageError
from nerfbake.jobs.budgets import EDGE, FRAMES
from nerfbake.jobs.files import AnySource, AnyTarget, Source, Target, as_source, as_target
from nerfbake.jobs.fit_course import Clock
from nerfbake.jobs.octrees import read_octree
from nerfbake.jobs.photographs import ALL, Album, Posed, read_photographs
from nerfbake.jobs.steps import SILENT, Steps

if TYPE_CHECKING:
    from nerfbake.stages.views_to_error import ViewError


class Model(NamedTuple):
    """What an octree is to look like: a finer scene or photographs.

    like    a PlenOctree, an octree or a volume, whose pictures are taken from all around
    frames  how many; edge: their pixels along an edge
    views   a capture; album: which of its photographs
    """

    like: str | None = None
    views: str | None = None
    frames: int = 100
    edge: int = EDGE
    album: Album = ALL

    def require(self) -> None:
        """Raises UsageError, before any work is done, unless there is one of them."""
        if (self.like is None) == (self.views is None):
            given = "both say" if self.like else "neither says"
            raise UsageError(f"`like` and `views`: {given} what IN is to look like; allowed: one of them")
        self.album.require()

    def posed(self, steps: Steps, samples: int) -> Posed:
        """Its pictures: those to fit to, and others to judge by. samples: rays along each edge of a pixel."""
        if self.views is not None:
            return read_photographs(steps, Source(self.views), self.album)
        bigger = Source(str(self.like))
        scene = bigger.read(steps, nerfbake.N3Tree, nerfbake.SparseVoxelOctree, nerfbake.Volume)
        with bigger.blamed(steps, f"taking pictures of {bigger.name}"):
            field = nerfbake.build_field(scene)
            around = nerfbake.sphere_cameras(field, frames=self.frames, edge=self.edge)
            judges = nerfbake.orbit_cameras(field, frames=FRAMES, width=self.edge, height=self.edge)
            return Posed(*(_taken(field, cameras, samples) for cameras in progress.each((around, judges))))


class Again(NamedTuple):
    """How the octree is fitted.

    epochs   how often every picture is looked at
    samples  rays along each edge of a pixel, as pictures of the octree are to be made: 1 or 2
    seed     of the order of the pictures: the same gives the same bytes
    """

    epochs: int = 2
    samples: int = 2
    seed: int = 0


TWICE = Again()


class Refitted(NamedTuple):
    """What refitting has changed, as the written file shows it.

    path    of the file, and its content in words, and its bytes
    before  how near IN came to each of the pictures that judge; after: how near the file does
    worked  CPU seconds, without compiling kernels, taking pictures and judging
    """

    path: str
    content: str
    bytes: int
    before: tuple[ViewError, ...]
    after: tuple[ViewError, ...]
    worked: float

    @property
    def psnr(self) -> tuple[float, float]:
        """dB before and after, the means over the pictures."""
        before, after = (sum(view.psnr for view in views) / len(views) for views in (self.before, self.after))
        return before, after


def refit_file(
    source: AnySource,
    target: AnyTarget,
    model: Model,
    *,
    again: Again = TWICE,
    no_child: int | None = None,
    steps: Steps = SILENT,
) -> Refitted:
    """Fits the values of an octree's leaves to what it is to look like, and gives what came of it; `nerfbake refit`.

    Reads `source`, a PlenOctree or an octree, and what `model` names; writes the octree `target`, whose nodes are
    those of `source`. no_child: how the file spells 'no child', 0 or -1; None: as is usual for the format. Raises
    NerfbakeError.

    >>> refitted = refit_file("octree.svo.npz", "refitted.svo.npz", Model(like="a.npz", frames=8, edge=64))
    >>> refitted.psnr[1] > 20
    True
    """
    source, target = as_source(source), as_target(target)
    model.require()
    _require(target, no_child)
    octree = read_octree(steps, source)
    with source.blamed(steps, "preparing"):
        cells = nerfbake.bricks_of_octree(octree)
    posed = model.posed(steps, again.samples)
    before = _seen(steps, source, octree, posed, again)
    field, worked = _fit(steps, source, cells, posed, again)
    with source.blamed(steps, "putting values back"):
        refitted = nerfbake.fill_octree(octree, field)
    target.write(steps, refitted, no_child=no_child)
    del octree, cells, field, refitted
    loaded = Source(target.path).read_with_format(steps)
    after = _seen(steps, Source(target.path), loaded.scene, posed, again)
    found = Refitted(target.path, str(loaded.scene), loaded.size, before, after, worked)
    was, now = found.psnr
    steps.say(f"{target.path}: {now:.2f} dB on {posed.judges}, where {source.name} has {was:.2f}")
    return found


def _require(target: Target, no_child: int | None) -> None:
    """Raises, before any work is done, if no octree can be written there."""
    if target.path == io.STREAM:
        raise UsageError("refit judges the file that it wrote; allowed: an OUT other than '-'")
    target.require("SparseVoxelOctree", no_child=no_child)


def _taken(field: nerfbake.RadianceField, cameras: nerfbake.Cameras, samples: int) -> nerfbake.Views:
    """Pictures of a field."""
    cameras.require_memory()

    def pictures() -> Iterator[Any]:
        for camera in progress.each(cameras.cameras):
            yield nerfbake.render_field(field, camera, background=None, samples=samples).pixels

    return nerfbake.build_views(cameras, pictures())


def _fit(
    steps: Steps, source: Source, cells: nerfbake.BrickField, posed: Posed, again: Again
) -> tuple[nerfbake.BrickField, float]:
    """The field that has the same cells and looks more like the pictures, and CPU seconds."""
    from nerfbake.stages.brick_field_to_brick_field import refit_bricks

    clock, count = Clock(), again.epochs * len(posed.trained.pictures)
    with steps.phase("refitting"), io.blame(source.name):
        for done, now in enumerate(refit_bricks(cells, posed.trained, **again._asdict())):
            progress.report(done / count, f"epoch {now.epoch + 1} of {again.epochs}")
        return now.field(), clock.worked


def _seen(steps: Steps, file: Source, scene: Any, posed: Posed, again: Again) -> tuple[ViewError, ...]:
    """How near pictures of a scene come to those that judge."""
    with file.blamed(steps, f"judging {file.name} by {len(posed.judges.pictures)} pictures"):
        return nerfbake.measure_views(nerfbake.build_field(scene), posed.judges, samples=again.samples)
