"""What a bake may cost, judged from the file or folder as it was written."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

import nerfbake
from nerfbake import io
from nerfbake.errors import BudgetMissed, NerfbakeError, UsageError
from nerfbake.jobs.files import FolderTarget, Source, Target
from nerfbake.jobs.steps import SILENT, Steps
from nerfbake.jobs.views import shown, views_of

FRAMES, EDGE = 8, 400  # the views around a scene that a budget is judged from, and their pixels along an edge


class Budget(NamedTuple):
    """What the pictures of an output may lose.

    min_psnr  the least mean PSNR against what it was made from, in dB; None: it may lose anything, and no picture is
              made
    cameras   a capture whose views judge; None: 8 views around the scene
    samples   rays along each edge of a pixel; None: as the cameras have it, or 1
    """

    min_psnr: float | None = None
    cameras: str | None = None
    samples: int | None = None

    def require(self, target: Target | FolderTarget) -> None:
        """Raises, before any work is done, UsageError if there would be no file to judge, and OutputError if
        OUT.rejected is there and may not be replaced.
        """
        if self.min_psnr is None:
            return
        if target.path == io.STREAM:
            raise UsageError("`min_psnr` judges a file; allowed: an OUT other than '-'")
        folder = isinstance(target, FolderTarget)
        io.require_rejected_absent(target.path, force=target.force, folder=folder)


UNLIMITED = Budget()


@contextmanager
def reporting(report: Callable[[], None]) -> Iterator[None]:
    """Reports behind a block that writes and judges, also where the budget is missed.

    By then the result has its name, so that a reader who closes the pipe does not lose it.
    """
    try:
        yield
    except BudgetMissed:
        report()
        raise
    report()


def judge(
    written: str,
    scene: Any,
    budget: Budget,
    *,
    made_from: str,
    name: str | None = None,
    up: str = "z",
    read: Callable[[str], Any] = io.load,
    steps: Steps = SILENT,
) -> float | None:
    """Renders a file or folder as it was written beside the scene that it was made from: the mean PSNR between them.

    Reads `written` and budget.cameras. Raises BudgetMissed, exit code 3, where the budget is missed. Gives None, and
    reads nothing, where the budget has no limit.

    made_from: what words and errors call the scene. name: what they call `written`, which may not have its own name
    yet; None: its path. up: the axis of a volume's world that the scene's z became. read:
    what makes a scene of `written` again, where that is not io.load().

    >>> tree = nerfbake.load("a.npz")
    >>> nerfbake.save("judged.svo.npz", nerfbake.build_octree(tree)) > 0
    True
    >>> judge("judged.svo.npz", tree, Budget(min_psnr=50), made_from="a.npz") > 50
    True
    """
    if budget.min_psnr is None:
        return None
    seen = shown(steps, scene, made_from)
    views = views_of(steps, seen, budget.cameras, name=made_from, frames=FRAMES, edge=EDGE, samples=budget.samples)
    name = written if name is None else name
    with Source(name).blamed(steps, "judging"):
        with steps.phase(f"reading {name}"):
            try:
                made = read(written)
            except NerfbakeError as error:
                error.source = name
                raise
        found = nerfbake.compare_scenes(seen, made.turned() if up == "y" else made, views, keep_pictures=False)
        found.require(min_psnr=budget.min_psnr)
    decibels = float(found.means["a_b"]["psnr"])
    steps.say(f"{name}: {decibels:.2f} dB against {made_from}{views.rays_told}")
    return decibels
