"""The photographs of a capture: found by the names that its cameras give them, read one at a time."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from nerfbake import memory
from nerfbake.catalog import load_photographs
from nerfbake.contract import PICTURES, picture_names
from nerfbake.errors import InvalidFile
from nerfbake.io.reading import load
from nerfbake.io.sources import blame, read_file


def find_photograph(folder: str | Path, name: str) -> Path | None:
    """The PNG or JPEG of this name in a folder, as picture_names() spells it; None where there is none."""
    if not name:
        return None
    paths = (Path(folder) / spelled for spelled in picture_names(name))
    return next((path for path in paths if path.is_file()), None)


def is_picture(path: str | Path) -> bool:
    """True if a file's ending is that of a PNG or a JPEG."""
    return Path(path).name.lower().endswith(PICTURES)


def picture_in(path: str | Path) -> Path | None:
    """The path of a picture, moving ones included, or of the first one in a folder; None where there is none."""
    path = Path(path)
    if path.is_dir():
        with blame(str(path)):
            return next((file for file in sorted(path.iterdir()) if is_picture(file)), None)
    return path if is_picture(path) or path.suffix.lower() == ".gif" else None


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


def load_photograph(path: str | Path, size: tuple[int, int] | None = None) -> Any:
    """(H, W, 4) uint8: sRGB and straight alpha, as the file has them; 255 where it has none.

    size: (W, H) of the camera, see decode_photograph(). Raises InvalidFile, MemoryLimit.
    """
    with blame(str(path)):
        with memory.scope():
            view = read_file(Path(path))
            if not len(view):
                raise InvalidFile("is empty; allowed: a PNG or a JPEG")
            pixels = load_photographs().decode_photograph(view, size)
        return memory.kept(pixels)


def load_thumbnail(path: str | Path, edge: int) -> bytes:
    """A picture as a PNG of at most so many pixels along each edge. Raises InvalidFile, MemoryLimit."""
    with blame(str(path)), memory.scope():
        return load_photographs().encode_thumbnail(read_file(Path(path)), edge)
