"""How files of splats are read and written: their axes, their version, and their precision."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

from nerfbake.errors import UsageError
from nerfbake.jobs.files import Source
from nerfbake.jobs.steps import Steps
from nerfbake.jobs.upright import upside_down_note
from nerfbake.scene.splat_axes import with_axes
from nerfbake.scene.splats import Axes, Splats


@dataclass(frozen=True, kw_only=True)
class SplatChoice:
    """By default everything is as the files say, or as the formats have it.

    in_axes      the axes in which the file to read is, instead of those that it names or its format has
    axes         of a .spz: the axes in which it is written, which it names; None: RUB
    spz_version  of a .spz: 3 or 4; None: 4
    half         of USD: store all but the centres in half floats
    small        store splats as small as the format allows
    """

    in_axes: Axes | None = None
    axes: Axes | None = None
    spz_version: Literal[3, 4] | None = None
    half: bool = False
    small: bool = False

    @property
    def of_format(self) -> dict[str, Any]:
        """The options of the format to write."""
        given = {
            "half": self.half or None,
            "small": self.small or None,
            "axes": self.axes,
            "spz_version": self.spz_version,
        }
        return {name: value for name, value in given.items() if value is not None}

    def read(self, steps: Steps, source: Source, splats: Splats) -> Splats:
        """Return splats that were read in the axes that are chosen for them. Raises UsageError, MemoryLimit."""
        if self.in_axes is None:
            if note := upside_down_note(splats):
                steps.say(f"{source.name}: {note}")
            return splats
        if splats.axes is None:
            found = f"`in_axes` has no effect on {source.name}, whose numbers are its world"
            raise UsageError(f"{found}; allowed: a file in axes of its format, or `in_up` for this one")
        with source.blamed(steps, "turning the splats"):
            return with_axes(splats, self.in_axes)
