"""Octrees compressed from files to files, as small or as good as is asked for."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import nerfbake
from nerfbake import io
from nerfbake.errors import UsageError
from nerfbake.jobs.budgets import UNLIMITED, Budget, judge, reporting
from nerfbake.jobs.files import AnySource, AnyTarget, Target, as_source, as_target
from nerfbake.jobs.octrees import read_octree_and_held_out
from nerfbake.jobs.steps import SILENT, Steps
from nerfbake.jobs.views import read_cameras

MAX_LOSS, SOURCE_PSNR = 0.1, 35.0  # dB


@dataclass(frozen=True)
class Goal:
    """What a compressed file may cost; one of the three, and none of them: a loss of 0.1 dB.

    max_loss  dB of PSNR against photographs
    max_size  bytes of the file, which are never exceeded
    step      of colour, for those who search themselves
    """

    max_loss: float | None = None
    max_size: int | None = None
    step: float | None = None

    @property
    def options(self) -> dict[str, Any]:
        """As compress_octree() takes them. Raises UsageError for two goals at once."""
        given = {name: value for name, value in vars(self).items() if value is not None}
        if len(given) > 1:
            names = " and ".join(f"`{name}`" for name in given)
            raise UsageError(f"{names} are two goals; allowed: one of `max_loss`, `max_size` and `step`")
        return given or {"max_loss": MAX_LOSS}


@dataclass(frozen=True)
class Photographs:
    """What the loss is measured against: cameras, a capture, and truth, a folder with a photograph NAME.png for each of
    them. Without both, the loss is measured on what the file of a fitted PlenOctree has of its photographs, else
    predicted for a source that is as near to its photographs as source_psnr, in dB.
    samples: rays along each edge of a pixel; None: as the cameras have it, or 1."""

    cameras: str | None = None
    truth: str | None = None
    source_psnr: float | None = None
    samples: int | None = None

    def require(self) -> None:
        """Raises UsageError for one without the other."""
        if self.truth and not self.cameras:
            raise UsageError("`truth` has no cameras; allowed: `truth` with `cameras`")
        if self.truth and self.source_psnr is not None:
            raise UsageError("`source_psnr` has no effect where `truth` measures it; allowed: one of them")

    def read(self, steps: Steps, held_out: nerfbake.HeldOut | None) -> dict[str, Any]:
        """As compress_octree() takes them; held_out: what the scene's file says itself, where nothing else is named."""
        if not (self.truth and self.cameras):
            if held_out is not None and self.source_psnr is None:
                return {"held_out": held_out}
            return {"source_psnr": SOURCE_PSNR if self.source_psnr is None else self.source_psnr}
        read = read_cameras(steps, self.cameras).chosen(samples=self.samples)
        truth = io.Truth(self.truth, read.names, nerfbake.Image)
        with steps.phase(f"reading {self.truth}"):
            return {"held_out": nerfbake.HeldOut.of_images(read.fitting(truth), truth)}


LEAST_LOSS, PREDICTED = Goal(), Photographs()


def coded_size_of(target: Target, **coding: Any) -> Callable[[nerfbake.QuantisedOctree], int]:
    """How many bytes a quantised octree has as this target writes it."""
    packed = io.format_for(target.path, "QuantisedOctree", to=target.to).load_packed_module()
    return lambda quantised: packed.coded_size(quantised, **coding)


def compress_file(
    source: AnySource,
    target: AnyTarget,
    *,
    goal: Goal = LEAST_LOSS,
    photographs: Photographs = PREDICTED,
    basis: str | None = None,
    budget: Budget = UNLIMITED,
    steps: Steps = SILENT,
    report: Callable[[nerfbake.Compression], None] | None = None,
    **coding: Any,
) -> nerfbake.Compression:
    """Compresses a PlenOctree or an octree, and gives what was found; `nerfbake compress` is this.

    Reads `source`, the photographs and the budget's cameras; writes `target`, or `target`.rejected where the budget is
    missed. basis: SHk of a lower degree. coding goes to the format. report gets what is returned when the file
    has its name, that of a rejected one too. Raises NerfbakeError.

    >>> compress_file("a.npz", "small.svoq", goal=Goal(step=0.1)).quantised.colour_step
    0.1
    """
    source, target = as_source(source), as_target(target)
    options = goal.options
    photographs.require()
    target.require("QuantisedOctree", **coding)
    budget.require(target)
    octree, held_out = read_octree_and_held_out(steps, source)
    options |= photographs.read(steps, held_out)
    with source.blamed(steps, "compressing") as tell:
        coded_size = coded_size_of(target, **coding)
        found = nerfbake.compress_octree(octree, coded_size=coded_size, basis=basis, tell=tell, **options)
    told = reporting(lambda: report(found) if report is not None else None)
    with told, target.writing(steps, found.quantised, **coding) as written:
        steps.say(f"{target.path}: {found}")
        judge(written.path, octree, budget, made_from=source.name, name=target.path, steps=steps)
    return found
