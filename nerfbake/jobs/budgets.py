"""Quality budgets: compare a written file or folder with its source."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from nerfbake import io
from nerfbake.device.adapters import AUTO as DEVICE
from nerfbake.errors import BudgetMissed, Problem
from nerfbake.jobs.files import FolderTarget, Source, Target, read_back_as
from nerfbake.jobs.steps import SILENT, Steps

if TYPE_CHECKING:
    from nerfbake.stages.renderers import Renderer

FRAMES, EDGE = 8, 400  # number of views around a scene that are compared, and their width and height in pixels


@dataclass(frozen=True, kw_only=True)
class Budget:
    """The lowest allowed quality of an output.

    min_psnr  lowest allowed mean PSNR of its pictures against those of its source, in dB; None: no limit, and no
              pictures are rendered
    cameras   a capture with the views to compare; None: 8 views around the scene, or 8 of those that a
              trained field has
    samples   rays along each edge of a pixel; None: from the cameras, else 1
    device    what renders fields and splats, as in renderer_on()
    """

    min_psnr: float | None = None
    cameras: str | None = None
    samples: int | None = None
    device: str = DEVICE

    def require(self, target: Target) -> None:
        """Check that the output can be compared. Call it before doing any work.

        Raises UsageError if the output is stdout, a pipe or a device, and OutputError if OUT.rejected exists and must
        not be replaced.
        """
        if self.min_psnr is not None:
            target.require_measurable("`min_psnr` needs an output file")
            io.require_rejected_absent(target.path, force=target.force)

    def require_folder(self, target: FolderTarget, scene: str, inputs: Sequence[str | None] = ()) -> None:
        """Raise NerfbakeError if OUT, or OUT.rejected if there is a limit, cannot be written as a folder.

        scene: the type of the scene. inputs: the paths that are read. Call it before doing any work.
        """
        target.require(scene, inputs)
        if self.min_psnr is not None:
            target._replace(path=str(io.rejected_path(target.path))).require(scene, inputs)

    def judge(self, psnr: float, what: str, judged_on: str) -> None:
        """Raise BudgetMissed if a mean PSNR in dB is below the limit.

        what: the output and its verb, as "the mesh has". judged_on: the pictures that it was measured on.
        """
        if self.min_psnr is not None and not psnr >= self.min_psnr:
            found = f"a mean PSNR of {psnr:.2f} dB on {judged_on}"
            raise BudgetMissed(Problem(what, found, f"`min_psnr={self.min_psnr:g}`"))

    @property
    def inputs(self) -> tuple[str | None, ...]:
        """The paths that measuring reads."""
        return (self.cameras,)


@contextmanager
def reporting(report: Callable[[], None]) -> Iterator[None]:
    """Call report() after a block that writes and compares an output, also if the budget is missed.

    The output has its final name by then, so it is not lost if the reader of stdout closes the pipe.
    """
    try:
        yield
    except BudgetMissed:
        report()
        raise
    report()


def judge_output(
    written: str,
    scene: Any,
    budget: Budget,
    *,
    made_from: str,
    name: str | None = None,
    up: str = "z",
    read: Callable[[str], Any] = io.load,
    render: Renderer | None = None,
    steps: Steps = SILENT,
) -> float | None:
    """Render a written file or folder and its source scene, and return the mean PSNR between them in dB.

    Reads `written` and budget.cameras. Returns None, and reads nothing, if the budget has no limit. Raises BudgetMissed
    (exit code 3) if the PSNR is below the budget.

    made_from  name of the source scene in messages
    name       name of `written` in messages, since it may not have its final name yet; None: its path
    up         the axis of a volume that the scene's z axis was mapped to
    read       function that loads `written`, instead of io.load()
    render     renders fields; None: what budget.device chooses

    >>> tree = nerfbake.load("a.npz")
    >>> nerfbake.save("judged.svo.npz", nerfbake.build_octree(tree)) > 0
    True
    >>> judge_output("judged.svo.npz", tree, Budget(min_psnr=50), made_from="a.npz") > 50
    True
    """
    if budget.min_psnr is None:
        return None

    from nerfbake.jobs.devices import renderer_on
    from nerfbake.jobs.views import renderable_scene, views_of
    from nerfbake.stages.scenes_to_comparison import compare_scenes

    render = render or renderer_on(budget.device, steps=steps)
    seen = renderable_scene(steps, scene, made_from)
    views = views_of(
        steps, seen, budget.cameras, name=made_from, frames=FRAMES, edge=EDGE, samples=budget.samples, own=True
    )
    with io.blame(budget.cameras or made_from):
        views.require_covered()
    name = written if name is None else name
    with Source(name).blamed(steps, "measuring the quality"):
        with steps.phase(f"reading {name}"), read_back_as(name):
            made = read(written)
        upright = made.turned() if up == "y" else made
        found = compare_scenes(seen, upright, views, keep_pictures=False, render=render)
        decibels = float(found.means["a_b"]["psnr"])
        io.report_result(psnr=decibels)
        found.require(min_psnr=budget.min_psnr)
    steps.say(f"{name}: {decibels:.2f} dB against {made_from}{views.rays_text}")
    return decibels
