"""Describe a file or a folder."""

from __future__ import annotations

from typing import Any

from nerfbake import io
from nerfbake.jobs.files import AnySource, as_source
from nerfbake.jobs.steps import SILENT, Steps
from nerfbake.jobs.upright import upside_down_note
from nerfbake.scene.splats import Splats
from nerfbake.stages.scene_to_summary import summarise_scene


def describe_file(source: AnySource, *, steps: Steps = SILENT) -> dict[str, Any]:
    """Return the contents, format and size of a file or folder of any kind. `nerfbake info --json` adds a version.

    Reads `source` and writes nothing. Raises NerfbakeError.

    >>> describe_file("a.npz")["kind"]
    'PlenOctree (N3Tree)'
    """
    source = as_source(source)
    with steps.phase(f"reading {source.name}"):
        found: io.Loaded[Any] = io.load_with_format(source.path)  # its notes are in the description
    of_file = {"file": source.path, "format": found.form.name, "bytes_on_disk": found.size, **found.packing}
    facts = of_file | summarise_scene(found.scene)
    if isinstance(found.scene, Splats) and (note := upside_down_note(found.scene)):
        facts["notes"] = [*(facts["notes"] or []), note]
    return facts
