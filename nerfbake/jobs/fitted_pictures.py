"""The pictures that meshes and splats are fitted to: photographs, or pictures of the scene that is rendered."""

from __future__ import annotations

from dataclasses import dataclass

from nerfbake.jobs.budgets import EDGE
from nerfbake.jobs.devices import DEVICE
from nerfbake.jobs.files import Source
from nerfbake.jobs.photographs import PhotographOptions, SplitViews, read_photographs_of, require_alike
from nerfbake.jobs.steps import Steps
from nerfbake.scene.radiance_field import RadianceField
from nerfbake.stages.renderers import Renderer

PICTURES = 100  # that are rendered of a scene


@dataclass(frozen=True, kw_only=True)
class FittedPictures:
    """The pictures that meshes and splats are fitted to.

    views        a capture; None: pictures of the scene, from all sides
    photographs  options for its photographs
    frames       number of rendered pictures; None: 100, or 50 for a mesh of a scene with scenery
    edge         their width and height in pixels
    device       what renders fields and splats, as in renderer_on()
    """

    views: str | None = None
    photographs: PhotographOptions = PhotographOptions()
    frames: int | None = None
    edge: int = EDGE
    device: str = DEVICE

    @property
    def inputs(self) -> tuple[str | None, ...]:
        """The paths that are read."""
        return (self.views, self.photographs.masks, self.photographs.test)

    def photographs_of(self, steps: Steps, source: Source, field: RadianceField, render: Renderer) -> SplitViews:
        """Return the photographs of the capture. Raises NerfbakeError if they show something else than the field."""
        capture = str(self.views)
        split = read_photographs_of(steps, Source(capture), self.photographs, field)
        require_alike(steps, source, field, split.held_out, capture, render)
        return split
