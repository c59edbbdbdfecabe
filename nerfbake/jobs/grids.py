"""Which grids of a volume a job works on, and how they stand."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import nerfbake
from nerfbake.errors import InvalidFile, UsageError
from nerfbake.jobs.files import Source
from nerfbake.jobs.steps import Steps


@dataclass(frozen=True)
class Choice:
    """Which grids of a volume, by name or number, and which axis of its world is up; nothing chosen: as it is."""

    grids: tuple[str, ...] = ()
    up: str | None = None

    def __bool__(self) -> bool:
        return bool(self.grids or self.up)

    def of(self, steps: Steps, source: Source, scene: Any) -> Any:
        """The scene as it was asked for. Raises UsageError where it is no volume and something was asked."""
        if self and not isinstance(scene, nerfbake.Volume):
            raise UsageError(f"{source.name} is no volume; allowed: no --grid and no --up")
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
            raise InvalidFile(problem._replace(allowed=f"{problem.allowed}; --grid for the others"), source=source.path)
        return chosen


AS_IT_IS = Choice()
