"""How a scene that is read becomes an octree: one set of options for every command."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

from nerfbake.errors import UsageError
from nerfbake.jobs.budgets import Budget
from nerfbake.scene.splats import Splats, Up
from nerfbake.stages.splat_box import OPACITY_MIN

EPOCHS = 1

Part = Literal["inner", "all"] | tuple[float, ...]


@dataclass(frozen=True, kw_only=True)
class ReadingOptions:
    """How a scene becomes an octree. Octrees and volumes, which have their own voxels, take none of these options.

    box          part of the scene. inner: of a scene with scenery its inner cube, of splats those that are not far
                 outside; all: also the shells around it, at most at 4096^3, or all splats; x0, y0, z0, x1, y1, z1: the
                 splats in this box of the octree's world
    basis        SH basis of the colours (lattices and splats only); None: SH9, or the degree of the splats
    scale        scale factor for world coordinates (lattices only)
    opacity_min  splats that are thinner are left out
    in_up        axis of the splats that becomes z; stated: that which the file states, else -y; None: the octree keeps
                 the world of the splats
    epochs       passes over pictures of the splats to which the voxels are fitted; 0: they are not fitted
    """

    box: Part = "inner"
    basis: str | None = None
    scale: float | None = None
    opacity_min: float = OPACITY_MIN
    in_up: Up | Literal["stated"] | None = None
    epochs: int = EPOCHS

    def up_of(self, splats: Splats) -> Up | None:
        """Return the axis of these splats that becomes z; None to keep their world."""
        return splats.up or "-y" if self.in_up == "stated" else self.in_up

    def require(self, budget: Budget, splats: Splats) -> None:
        """Raise UsageError for cameras in the world that the splats are turned away from."""
        if (up := self.up_of(splats)) not in (None, "z") and budget.cameras is not None:
            text = f"splats are turned until {up} is z, and `cameras` are not"
            raise UsageError(f"{text}; allowed: z as the up axis of splats, which keeps their world")

    @property
    def given(self) -> set[str]:
        """The options that are not the default; the axis that a file states is one, too."""
        plain, default = replace(self, in_up=None) if self.in_up == "stated" else self, vars(ReadingOptions())
        names = {name for name, value in vars(plain).items() if value != default[name]}
        return names if isinstance(self.box, str) else names - {"box"} | {"box of six numbers"}
