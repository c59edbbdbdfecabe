"""What a file is, in facts."""

from __future__ import annotations

from typing import Any

import nerfbake
from nerfbake.jobs.files import AnySource, as_source
from nerfbake.jobs.steps import SILENT, Steps


def describe_file(source: AnySource, *, steps: Steps = SILENT) -> dict[str, Any]:
    """What a file or folder of any kind holds, its format and its size; `nerfbake info --json` prints this.

    Reads `source`, writes nothing. Raises NerfbakeError.

    >>> describe_file("a.npz")["kind"]
    'PlenOctree (N3Tree)'
    """
    source = as_source(source)
    scene, form, size = source.read_with_format(steps)
    return {"file": source.path, "format": form.name, "bytes_on_disk": size, **nerfbake.summarise_scene(scene)}
