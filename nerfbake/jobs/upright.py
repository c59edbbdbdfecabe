"""Turn splats until they stand upright in their file, and tell that a file looks upside down."""

from __future__ import annotations

from dataclasses import replace

from nerfbake.errors import UsageError
from nerfbake.jobs.files import Source
from nerfbake.jobs.steps import Steps
from nerfbake.scene.splats import UPS, Splats, Up


def upside_down_note(splats: Splats) -> str:
    """Return a line for splats that look upside down, if their file names no axes; '' for others."""
    from nerfbake.stages.splats_to_up import measure_stand

    if splats.axes is None or splats.axes_known or splats.up not in (None, "-y"):
        return ""
    stand = measure_stand(splats)
    if not stand.upside_down:
        return ""
    told = f"its upper end has {1 / stand.ratio:.1f} times the area of its lower one"
    return f"this file looks upside down ({told}); try `in_axes=RDF` of `nerfbake convert`"


def require_up(in_up: str | None) -> Up | None:
    """Return the axis that points up in the world of splats. Raises UsageError. Call it before doing any work."""
    found: Up | None = next((up for up in UPS if up == in_up), None)
    if found != in_up:
        raise UsageError(f"`in_up` is {in_up!r}; allowed: {', '.join(UPS)}")
    return found


def turned_up(steps: Steps, source: Source, in_up: Up | None, *levels: Splats) -> tuple[Splats, ...]:
    """Return splats turned so that this axis of their world becomes -y; None: as they are, and print what that means.

    levels: splats by level of detail, at least one. The formats store -y as their own up axis.
    """
    if in_up is not None:
        return tuple(splats.with_up(in_up) for splats in levels)
    if (up := levels[0].up) not in (None, "-y"):
        steps.say(f"{source.name}: {up} points up, as the file says; only `in_up={up}` turns the splats")
    return levels


def fields_turned_up(
    levels: tuple[Splats, ...], in_up: Up | None, *, keeps_up: bool
) -> tuple[tuple[Splats, ...], Up | None]:
    """Return splats of a field as they stand upright in a format, and the axis by which they were turned.

    levels: splats by level of detail. in_up: the axis of the field that points up. None: z, by which they are not
    turned if the format says that z is up (keeps_up).
    """
    if in_up is None and keeps_up:
        return tuple(replace(splats, up="z") for splats in levels), None
    axis = in_up or "z"
    return tuple(splats.with_up(axis) for splats in levels), axis
