"""Which grids of a volume a job reads or writes, and how they stand."""

from __future__ import annotations

from typing import Any, NamedTuple

import nerfbake
from nerfbake import catalog
from nerfbake.errors import InvalidFile, UsageError
from nerfbake.jobs.files import Source
from nerfbake.jobs.steps import Steps

GRIDS = ("density", "Cd", "sh", "index")


class Choice(NamedTuple):
    """Which grids of a volume, by name or number, and which axis of its world is up; nothing chosen: as it is."""

    grids: tuple[str, ...] = ()
    up: str | None = None

    def __bool__(self) -> bool:
        return bool(self.grids or self.up)

    def of(self, steps: Steps, source: Source, scene: Any) -> Any:
        """The scene as it was asked for. Raises UsageError where it is no volume and something was asked."""
        if self and not isinstance(scene, nerfbake.Volume):
            raise UsageError(f"{source.name} is no volume; allowed: no `grid` and no `up`")
        if self:
            with source.blamed(steps, "choosing grids"):
                scene = scene.only(self.grids) if self.grids else scene
                scene = scene.turned() if self.up == "y" else scene
        return scene

    def whole(self, steps: Steps, source: Source, scene: Any) -> Any:
        """The same; raises InvalidFile where a grid would be left out that nobody left out."""
        chosen = self.of(steps, source, scene)
        if isinstance(chosen, nerfbake.Volume) and chosen.unread:
            problem = chosen.unread[0]
            raise InvalidFile(problem._replace(allowed=f"{problem.allowed}; `grid` for the others"), source=source.path)
        return chosen


AS_IT_IS = Choice()


def require_grids(form: catalog.Format, grids: str | None, *, half: bool) -> tuple[str, ...]:
    """These grids, or those that the format has where nobody says which.

    Raises UsageError, before any work is done, for grids that it cannot hold.
    """
    module = form.load_volume_module()
    wanted = tuple(grids.split(",")) if grids else module.DEFAULT_GRIDS
    if not set(wanted) <= set(GRIDS) or len(set(wanted)) < len(wanted) or ("index" in wanted and len(wanted) > 1):
        raise UsageError(f"`grids` are {','.join(wanted)!r}; allowed: some of density, Cd, sh, or index alone")
    module.require_grids(wanted, half=half)
    return wanted


def tell_of_halves(steps: Steps, form: catalog.Format, volume: nerfbake.Volume) -> None:
    """Says what other programs make of a density in halves."""
    note, first = form.load_volume_module().HALF_NOTE, volume.grids[0]
    if note and isinstance(first, nerfbake.VdbTree) and first.values.dtype == "float16":
        steps.say(note)
