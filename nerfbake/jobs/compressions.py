"""Compress octrees to files of a given loss or size."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

from nerfbake import io
from nerfbake.errors import UsageError
from nerfbake.jobs.budgets import Budget, judge_output, reporting
from nerfbake.jobs.devices import renderer_on
from nerfbake.jobs.files import AnySource, AnyTarget, Target, as_source, as_target
from nerfbake.jobs.function_voxels import FunctionVoxels
from nerfbake.jobs.readings import Reading
from nerfbake.jobs.steps import SILENT, Steps
from nerfbake.jobs.views import read_cameras
from nerfbake.scene.compression import Compression
from nerfbake.scene.held_out import HeldOut
from nerfbake.scene.image import Image
from nerfbake.scene.quantised_octree import QuantisedOctree
from nerfbake.stages.octree_to_compression import compress_octree

MAX_LOSS = 0.1  # dB


@dataclass(frozen=True, kw_only=True)
class CompressionGoal:
    """The goal of a compression: one of these three. Without any, the goal is a loss of 0.1 dB.

    max_loss  largest loss of PSNR against photographs, in dB
    max_size  largest size of the file in bytes, never exceeded
    step      quantisation step of the colours, if you search for the best one yourself
    """

    max_loss: float | None = None
    max_size: int | None = None
    step: float | None = None

    @property
    def options(self) -> dict[str, Any]:
        """The arguments of compress_octree(). Raises UsageError if more than one goal is set."""
        given = {name: value for name, value in vars(self).items() if value is not None}
        if len(given) > 1:
            names = " and ".join(f"`{name}`" for name in given)
            raise UsageError(f"{names} are two goals; allowed: one of `max_loss`, `max_size` and `step`")
        return given or {"max_loss": MAX_LOSS}


@dataclass(frozen=True, kw_only=True)
class GroundTruth:
    """The photographs on which the loss is measured.

    cameras      a capture
    truth        a folder with a photograph NAME.png for each of the cameras
    source_psnr  PSNR of the source against its photographs in dB, to predict the loss from; None: 30.5
    samples      rays along each edge of a pixel; None: from the cameras, else 1

    Without cameras and truth, the loss is measured on the pixels of photographs that a fitted PlenOctree stores. If the
    source stores none, or if source_psnr is given, the loss is predicted.
    """

    cameras: str | None = None
    truth: str | None = None
    source_psnr: float | None = None
    samples: int | None = None

    def require(self) -> None:
        """Raise UsageError if truth has no cameras, or if both truth and source_psnr are given."""
        if self.truth and not self.cameras:
            raise UsageError("`truth` has no cameras; allowed: `truth` with `cameras`")
        if self.truth and self.source_psnr is not None:
            raise UsageError("`source_psnr` has no effect with `truth`, which measures it; allowed: one of them")

    def read(self, steps: Steps, held_out: HeldOut | None) -> dict[str, Any]:
        """Return arguments of compress_octree(). held_out: the pixels that the source stores, used without truth."""
        if not (self.truth and self.cameras):
            if held_out is not None and self.source_psnr is None:
                return {"held_out": held_out}
            return {} if self.source_psnr is None else {"source_psnr": self.source_psnr}
        read = read_cameras(steps, self.cameras).chosen(samples=self.samples)
        truth = io.Truth(self.truth, read.names, Image)
        with steps.phase(f"reading {self.truth}"), io.blame(self.cameras):
            read.require_covered()
            return {"held_out": HeldOut.of_images(read.fitting(truth), truth)}


Coding = Literal["range", "deflate"]  # of .svoq


def coded_size_of(target: Target, coding: Coding = "range") -> Callable[[QuantisedOctree], int]:
    """Return a function that computes the size in bytes of a quantised octree in the target's format."""
    packed = io.format_for(target.path, "QuantisedOctree", to=target.to).load_packed_module()
    return lambda quantised: packed.coded_size(quantised, coding=coding)


def compress_file(
    source: AnySource,
    target: AnyTarget,
    *,
    goal: CompressionGoal = CompressionGoal(),
    photographs: GroundTruth = GroundTruth(),
    basis: str | None = None,
    coding: Coding = "range",
    functions: FunctionVoxels = FunctionVoxels(),
    budget: Budget = Budget(),
    steps: Steps = SILENT,
    report: Callable[[Compression], None] | None = None,
) -> Compression:
    """Compress the octree of a scene and return the result. This is `nerfbake compress`.

    Reads `source`, the photographs and the cameras of the budget. Writes `target`, or `target`.rejected if the budget
    is missed. Raises NerfbakeError.

    basis   SHk of a lower degree, to which the colours are reduced first
    coding  of the coefficients: range is smaller, deflate faster to read
    functions  how a trained field becomes voxels
    report  is called with the result once the file has its final name, also if it is rejected

    >>> compress_file("a.npz", "small.svoq", goal=CompressionGoal(step=0.1)).quantised.colour_step
    0.1
    """
    source, target = as_source(source), as_target(target)
    options = goal.options
    photographs.require()
    target.require("QuantisedOctree", coding=coding)
    budget.require(target)
    render = renderer_on(budget.device, steps=steps)
    reading = Reading(steps, source, functions=functions)
    reading.require()
    octree, held_out = reading.octree(), reading.held_out
    shown = None if budget.min_psnr is None else reading.shown
    del reading
    options |= photographs.read(steps, held_out)
    with source.blamed(steps, "compressing") as tell:
        coded_size = coded_size_of(target, coding)
        found = compress_octree(octree, coded_size=coded_size, basis=basis, tell=tell, render=render, **options)
    reported = reporting(lambda: report(found) if report is not None else None)
    with reported, target.writing(steps, found.quantised, coding=coding) as written:
        steps.say(f"{target.name}: {found}")
        judge_output(written.path, shown, budget, made_from=source.name, name=target.path, render=render, steps=steps)
    return found
