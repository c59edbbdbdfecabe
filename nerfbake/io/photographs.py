"""The photographs of a capture: found by the names that its cameras give them, read one at a time."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from nerfbake import memory
from nerfbake.catalog import load_photographs
from nerfbake.contract import PICTURES
from nerfbake.errors import InvalidFile
from nerfbake.io.sources import blame, read_file


def find_photograph(folder: str | Path, name: str) -> Path | None:
    """The PNG or JPEG of this name in a folder, whose ending the name may leave out; None where there is none."""
    if not name:
        return None
    paths = (Path(folder) / f"{name}{ending}" for ending in ("", *PICTURES))
    return next((path for path in paths if path.is_file()), None)


def load_photograph(path: str | Path) -> Any:
    """(H, W, 4) uint8: sRGB and straight alpha, as the file has them; 255 where it has none.

    Raises InvalidFile, MemoryLimit.
    """
    with blame(str(path)):
        with memory.scope():
            view = read_file(Path(path))
            if not len(view):
                raise InvalidFile("is empty; allowed: a PNG or a JPEG")
            pixels = load_photographs().decode_photograph(view)
        return memory.kept(pixels)
