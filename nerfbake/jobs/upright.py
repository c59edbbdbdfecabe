"""Tell that a file of splats looks upside down."""

from __future__ import annotations

from nerfbake.scene.splats import Splats


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
