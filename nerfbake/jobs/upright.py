"""Turn splats until they stand upright in their file, and tell that a file looks upside down."""

from __future__ import annotations

from dataclasses import replace

from nerfbake import catalog
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


def turned_up(steps: Steps, source: Source, splats: Splats, in_up: Up | None) -> Splats:
    """Return splats turned so that this axis of their world becomes -y; None: as they are, and print what that means.

    The formats store -y as their own up axis.
    """
    if in_up is not None:
        return splats.with_up(in_up)
    if splats.up not in (None, "-y"):
        steps.say(f"{source.name}: {splats.up} points up, as the file says; only `in_up={splats.up}` turns the splats")
    return splats


def field_turned_up(form: catalog.Format, splats: Splats, in_up: Up | None) -> tuple[Splats, Up | None]:
    """Return splats of a field as they stand upright in this format, and the axis by which they were turned.

    in_up: the axis of the field that points up. None: z, by which they are not turned if the format says that z is up.
    """
    if in_up is None and form.load_splat_module().KEEPS_UP:
        return replace(splats, up="z"), None
    axis = in_up or "z"
    return splats.with_up(axis), axis
