"""The photographs of a capture: found by the names that its cameras give them, read one at a time."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from nerfbake import memory
from nerfbake.catalog import load_photographs
from nerfbake.contract import PICTURES
from nerfbake.errors import InvalidFile
from nerfbake.io.reading import load
from nerfbake.io.sources import blame, read_file


def find_photograph(folder: str | Path, name: str) -> Path | None:
    """The PNG or JPEG of this name in a folder, whose ending the name may leave out; None where there is none."""
    if not name:
        return None
    paths = (Path(folder) / f"{name}{ending}" for ending in ("", *PICTURES))
    return next((path for path in paths if path.is_file()), None)


class Truth(Sequence[Any]):
    """The photographs NAME.png of these names in a folder, as Images, the type of scene that is handed in. Each is read
    whenever it is asked for: all at once may not fit into memory.
    """

    def __init__(self, folder: str | Path, names: Iterable[str], image: type[Any]) -> None:
        self._paths, self._image = [Path(folder) / f"{name}.png" for name in names], image

    def __len__(self) -> int:
        return len(self._paths)

    def __getitem__(self, i: Any) -> Any:
        return load(self._paths[i], self._image)


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
