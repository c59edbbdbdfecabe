"""Shared parts of the readers of other tools: pictures found by their label, sizes, numbers in text, and the result.

These files stand beside the pictures, in a subfolder of them or above them, and name them by a label: a file name with
or without extension, or a path on the computer of whoever made the file. Such a path is never followed: only its end,
in the folder of the capture.
"""

from __future__ import annotations

import math
from codecs import BOM_UTF8
from collections import Counter
from collections.abc import Iterator, Sequence
from typing import NamedTuple

from nerfbake import memory
from nerfbake.contract import PICTURES, composed_name, picture_names
from nerfbake.errors import InvalidFile, Problem
from nerfbake.formats.camera.capture import (
    DEFAULT_EDGE,
    MAX_FRAMES,
    CaptureFolder,
    PictureSizes,
    Size,
    inside_of,
    names_of,
    room_for,
    size_note,
    visible_names,
)
from nerfbake.kernels.arrays import Floats
from nerfbake.kernels.soundness import MAX_EDGE
from nerfbake.scene.camera import Camera, Cameras
from nerfbake.scene.lens import Lens
from nerfbake.scene.sparse_points import SparsePoints

MAX_VALUE = 1e15  # largest number in a file
MAX_TURN = 1e5  # largest angle, in any unit
FOLDERS = ("images", "", "image", "rgb", "photos")  # of pictures in a capture, the most usual first


class Posed(NamedTuple):
    """A picture with its camera. label: its name in the file; picture: its path in the capture, '' if unknown."""

    label: str
    picture: str
    pose: Floats
    size: Size
    focal: tuple[float, float]
    centre: tuple[float, float] | None = None
    lens: Lens | None = None


class Intrinsic(NamedTuple):
    """What several pictures have in common in files that list their lenses apart."""

    size: Size
    focal: tuple[float, float]
    centre: tuple[float, float]
    lens: Lens


def cameras_of(
    posed: Sequence[Posed], *, dialect: str, source: str, notes: Sequence[str] = (), points: SparsePoints | None = None
) -> Cameras:
    """Return the cameras of these pictures, in their order. dialect: the tool; source: its file.

    Pictures of several cards may have equal names in different folders, and a label says nothing of the folder. Such
    cameras have no picture, so that none gets the wrong one.
    """
    room_for(len(posed))
    times = Counter(each.picture for each in posed)
    cameras = []
    for each, name in zip(posed, names_of(each.label for each in posed), strict=True):
        picture = each.picture if times[each.picture] == 1 else ""
        cameras.append(Camera(*each.size, each.focal, each.pose, name, each.centre, unbent(each.lens), picture))
    twice = next((picture for picture, count in times.items() if picture and count > 1), "")
    if twice:
        notes = (*notes, f"warning: {times[twice]} cameras name the picture {twice}, so it belongs to none of them")
    return Cameras(tuple(cameras), dialect, source, tuple(notes), points=points)


def unbent(lens: Lens | None) -> Lens | None:
    """None for a lens that does nothing, so that equal cameras are equal."""
    return lens if lens is not None and lens.bends else None


class Album:
    """The pictures of a capture. folders: where they may be, the most likely one first."""

    def __init__(self, files: CaptureFolder, folders: Sequence[str] = FOLDERS) -> None:
        self._files, self._folders = files, folders
        self._sizes = PictureSizes(files)
        self._names: dict[str, dict[str, str]] = {}  # by folder: composed name -> stored name

    def find(self, label: str) -> str:
        """Return the path of a picture by its label: where the label says, else by its name in one of the folders.

        If there is no such picture, the path where it is expected is returned; '' for a label that names none.
        """
        name = inside_of(label.replace("\\", "/").rpartition("/")[2])
        inside = inside_of(label)
        if not name:
            return ""
        for path in dict.fromkeys(
            [
                *((f"{folder}/{inside}" if folder else inside) for folder in self._folders if inside),
                *((f"{folder}/{name}" if folder else name) for folder in self._folders),
            ]
        ):
            if (stored := self._stored(path)) is not None:
                return stored
        return inside or name

    def numbered(self) -> list[str]:
        """The paths of all pictures in the first of the folders that has some, by name."""
        for folder in self._folders:
            if names := visible_names(self._files, folder, PICTURES):
                return [f"{folder}/{name}" if folder else name for name in names]
        return []

    def size(self, path: str) -> Size | None:
        """The size of a picture; None if it does not exist or cannot be read."""
        return self._sizes.of(path)

    def sizes(self, paths: Sequence[str]) -> tuple[list[Size], tuple[str, ...]]:
        """The size of each picture, else that of the first with one, else the default; and notes of such guesses."""
        found = [self._sizes.of(path) for path in paths]
        first = next((size for size in found if size), None)
        guessed = sum(size is None for size in found)
        default = first or (DEFAULT_EDGE, DEFAULT_EDGE)
        return [size or default for size in found], size_note(guessed, first, self._sizes.unreadable)

    def _stored(self, path: str) -> str | None:
        folder, _, name = path.rpartition("/")
        if folder not in self._names:
            names = self._files.names(folder)
            self._names[folder] = {composed_name(each): each for each in names} | {each: each for each in names}
        known = self._names[folder]
        for spelled in picture_names(name):
            stored = known.get(spelled) or known.get(composed_name(spelled))
            if stored is not None and stored.endswith(PICTURES):
                return f"{folder}/{stored}" if folder else stored
        return None


def require_count(count: int, name: str) -> None:
    """Raise InvalidFile for no cameras or too many. cameras_of() counts their memory."""
    if not 1 <= count <= MAX_FRAMES:
        raise InvalidFile(Problem(name, f"has {count:,} cameras", f"1 to {MAX_FRAMES:,}"))


def numbers_in(text: str, place: str, count: int | None = None) -> list[float]:
    """Return the numbers in a text, between spaces. Raises InvalidFile unless there are `count` finite ones."""
    parts = text.split()
    if count is not None and len(parts) != count:
        raise InvalidFile(Problem(place, f"has {len(parts):,} numbers", f"{count}"))
    return finite(parts, place)


def finite(parts: Sequence[str], place: str) -> list[float]:
    """Return these texts as numbers. Raises InvalidFile for one that is not finite."""
    try:
        numbers = [float(part) for part in parts]
    except ValueError:
        numbers = [math.nan]
    if not all(abs(number) <= MAX_VALUE for number in numbers):
        raise InvalidFile(Problem(place, "holds a value that is not a number", f"numbers up to {MAX_VALUE:g}"))
    return numbers


def edge_of(value: float, place: str) -> int:
    """Return a width or a height in pixels as an integer. Raises InvalidFile."""
    if value != int(value) or not 1 <= value <= MAX_EDGE:
        raise InvalidFile(Problem(place, f"is {value:g}", f"1 to {MAX_EDGE:,} pixels"))
    return int(value)


def turn_limited(values: Sequence[float], place: str) -> Sequence[float]:
    """Return angles that sine and cosine take. Raises InvalidFile."""
    if any(abs(value) > MAX_TURN for value in values):
        raise InvalidFile(Problem(place, f"is {max(map(abs, values)):g}", f"an angle up to {MAX_TURN:g}"))
    return values


def text_lines(view: memoryview, name: str, *, most: int = 8192) -> Iterator[tuple[int, str]]:
    """Yield (number, text) of the lines that are neither empty nor comments (#), stripped.

    most: bytes that a line may have.
    """
    memory.hold(name, len(view))
    data, number = bytes(view), 0
    start, size = 3 if data.startswith(BOM_UTF8) else 0, len(data)
    while start < size:
        end = data.find(b"\n", start)
        end = size if end < 0 else end
        number += 1
        if end - start > most:
            raise InvalidFile(Problem(f"{name}: line {number:,}", f"has {end - start:,} bytes", f"up to {most:,}"))
        text = data[start:end].decode(errors="replace").strip()
        if text and not text.startswith("#"):
            yield number, text
        start = end + 1
