"""Options of a fit, and the schedule that they select."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

from nerfbake import __version__
from nerfbake.device.adapters import AUTO
from nerfbake.errors import InvalidScene, UsageError
from nerfbake.scene.schedule import (
    MAX_MINUTES,
    Schedule,
    parse_schedule,
    preset_schedule,
    scenery_schedule,
    schedule_for,
)
from nerfbake.scene.views import Views

if TYPE_CHECKING:
    from nerfbake.device.gpu import Gpu

Exposure = Literal["auto", "fit", "fixed"]
PRESET = "balanced"


@dataclass(frozen=True, kw_only=True)
class FitOptions:
    """Options of a fit.

    preset      schedule of stages: fast, balanced or best; None: balanced, unless minutes or epochs is given
    minutes     select a schedule that takes this many minutes on two cores, or on the graphics card
    epochs      schedule as text, in the notation in which it is printed; it sets its own resolution and samples
    resolution  cells along each axis of the lattice, before some of them are split; with scenery, of the inner cube,
                after some of them are split; None: 256, or 512 for objects in pictures of 600 pixels or more
    samples     rays along each edge of a pixel, 1 or 2: choose the value that the field will be rendered with; with
                scenery it is only measured with them
    basis       SH basis of the colours, SH1 to SH25; None: SH9, or SH16 for the preset best of an object
    box         x0, y0, z0, x1, y1, z1 of the box around the object in world coordinates, or of the inner cube of
                scenery; None: from the pictures, or from the cameras
    seed        seed for the order of the views: the same seed gives the same bytes
    device      what does the work. auto: a graphics card if there is one, else the CPU; cpu; gpu: a graphics card; or a
                part of an adapter's name. Cards give other bytes than the CPU
    exposure    fit: also fit a gain for each view and channel, which removes differences of exposure and of white
                balance; fixed: use all pictures as they are; auto: fit for pictures with scenery
    """

    preset: str | None = None
    minutes: float | None = None
    epochs: str | None = None
    resolution: int | None = None
    samples: int = 2
    basis: str | None = None
    box: tuple[float, float, float, float, float, float] | None = None
    seed: int = 0
    exposure: Exposure = "auto"
    device: str = AUTO

    def basis_of(self, views: Views) -> str:
        """Return the basis of the fit of these views."""
        return self.basis or ("SH16" if self.preset == "best" and not views.scenery else "SH9")

    def gains(self, views: Views) -> bool:
        """Return whether the fit of these views has gains."""
        return self.exposure == "fit" or (self.exposure == "auto" and views.scenery)

    def schedule(self, views: Views | None = None, *, gpu: Gpu | None = None) -> Schedule:
        """Return the stages. views: the training views, if known. Raises UsageError for contradictory options.

        gpu: `minutes` are those of this device, whose speed is measured. Raises DeviceError.
        """
        given = [name for name in ("preset", "minutes", "epochs") if getattr(self, name) is not None]
        if len(given) > 1:
            names = " and ".join(f"`{name}`" for name in given)
            raise UsageError(f"{names} each select a schedule; allowed: one of them")
        request: dict[str, Any] = {"resolution": self.resolution, "samples": self.samples}
        minutes, edge = self.minutes, 0
        if minutes is not None and gpu is not None:
            from nerfbake.stages.fit_speed import measure_speed  # here, because a fit seldom needs it

            minutes = min(minutes * measure_speed(gpu), MAX_MINUTES)
        if views is not None:
            edge = min(min(camera.width, camera.height) for camera in views.cameras.cameras)
            request |= {"views": len(views.pictures), "edge": edge}
        try:
            if self.epochs is not None:
                return parse_schedule(self.epochs)
            if views is not None and views.scenery:
                pixels = sum(camera.width * camera.height for camera in views.cameras.cameras) / len(views.pictures)
                sizes: dict[str, Any] = {"views": len(views.pictures), "edge": edge, "pixels": pixels}
                sizes["resolution"] = self.resolution or 256
                return scenery_schedule(self.preset or PRESET, **sizes, minutes=minutes)
            if views is not None:
                request["side"] = views.side()
            if minutes is not None:
                return schedule_for(minutes, **request)
            return preset_schedule(self.preset or PRESET, **request)
        except InvalidScene as error:
            raise UsageError(error.what) from None

    def rays(self, schedule: Schedule) -> int:
        """Return the rays along each edge of a pixel, 1 or 2, with which the held-out views are rendered."""
        return self.samples if self.epochs is None else min(schedule[-1].rays, 2)

    def fingerprint(self, schedule: Schedule, views: Views) -> dict[str, str]:
        """Return everything besides the pictures that the output bytes depend on."""
        rest = {name: str(getattr(self, name)) for name in ("box", "seed", "exposure")}
        return {"nerfbake": __version__, "schedule": str(schedule), "basis": self.basis_of(views), **rest}
