"""Read the folder of a .sog: meta.json with its pictures, or lod-meta.json with a folder for each part.

formats/splat/sog.py describes the contents.
"""

from __future__ import annotations

from collections.abc import Mapping

from nerfbake.formats.splat.sog import LOD, META, splats_in
from nerfbake.scene.splats import Splats


def recognise(files: Mapping[str, memoryview]) -> bool:
    """Return True for a folder with meta.json or lod-meta.json."""
    return META in files or LOD in files


def decode(files: Mapping[str, memoryview], *, member: str | None = None) -> Splats:
    """Parse splats. Raises InvalidFile, InvalidScene, MemoryLimit. `member`, one of these files, changes nothing."""
    return splats_in(files)
