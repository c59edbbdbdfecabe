"""Read and write the folder of a .sog: meta.json with its pictures. Also read lod-meta.json, the finest level.

formats/splat/sog.py describes the contents.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping

from nerfbake.formats.splat.sog import KEEPS_ORIGIN as KEEPS_ORIGIN
from nerfbake.formats.splat.sog import KEEPS_UP as KEEPS_UP
from nerfbake.formats.splat.sog import LOD, META, splats_in
from nerfbake.formats.splat.sog import MOST_DEGREE as MOST_DEGREE
from nerfbake.formats.splat.sog_writer import files_of
from nerfbake.formats.splat.sog_writer import in_order as in_order
from nerfbake.scene.splats import Splats

FILES = re.compile(r"meta\.json|(means_l|means_u|scales|quats|sh0|shN_centroids|shN_labels)\.webp")


def recognise(files: Mapping[str, memoryview]) -> bool:
    """Return True for a folder with meta.json or lod-meta.json."""
    return META in files or LOD in files


def encode(scene: Splats) -> Iterator[tuple[str, Iterable[bytes]]]:
    """Yield the files by name, as in a .sog. Raises InvalidScene, MemoryLimit."""
    for name, data in files_of(scene).items():
        yield name, [data]


def decode(files: Mapping[str, memoryview], *, member: str | None = None) -> Splats:
    """Parse splats. Raises InvalidFile, InvalidScene, MemoryLimit. `member`, one of these files, changes nothing."""
    return splats_in(files)
