"""What a file is, in facts."""

from __future__ import annotations

from typing import Any

import nerfbake
from nerfbake.jobs.files import AnySource, as_source
from nerfbake.jobs.steps import SILENT, Steps


def describe_file(source: AnySource, *, steps: Steps = SILENT) -> dict[str, Any]:
    """What a file or folder of any kind holds, its format and its size; `nerfbake info --json` adds a version.

    Reads `source`, writes nothing. Raises NerfbakeError.

    >>> describe_file("a.npz")["kind"]
    'PlenOctree (N3Tree)'
    """
    source = as_source(source)
    found = source.read_with_format(steps)
    of_file = {"file": source.path, "format": found.form.name, "bytes_on_disk": found.size, **found.packing}
    return of_file | nerfbake.summarise_scene(found.scene)
