"""What all dialects of cameras share: a folder's files, names that are safe as files, sizes told by the pictures."""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import Protocol

import numpy as np
import numpy.typing as npt

from nerfbake import memory
from nerfbake.contract import PICTURES, picture_names
from nerfbake.errors import InvalidFile, Problem
from nerfbake.kernels.maths.affine import combined

MAX_FRAMES = 100_000
DEFAULT_EDGE = 800  # pixels, the size of the Blender scenes
MAX_NAME = 120  # bytes of a name; what stands beside a picture, and a file that is not yet whole, have longer ones
_UNSAFE = re.compile(r"[^\w .+()\[\]-]")
_OTHERS = (".webp", ".exr", ".tif", ".tiff", ".bmp", ".hdr")
_MAX_PATH = 1000  # characters
_MAX_PART = 240  # bytes of a file's name, before an ending is tried
_CAMERA_BYTES = 1000  # what Python takes for one
_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])

Size = tuple[int, int]


class Folder(Protocol):
    """Files by name, where a name may lead into folders below; nothing is read before it is asked for."""

    def __contains__(self, name: object) -> bool: ...

    def __getitem__(self, name: str) -> memoryview: ...

    def names(self, folder: str) -> list[str]:
        """Of the files in a folder below ('' for this one), sorted; none where there is no such folder."""

    def head(self, name: str) -> bytes:
        """The first bytes of a file; none where there is no such file."""


def room_for(frames: int) -> None:
    """Raises InvalidFile for no frames or too many, MemoryLimit where their cameras do not fit."""
    if not 1 <= frames <= MAX_FRAMES:
        raise InvalidFile(Problem("the frames", f"are {frames:,}", f"1 to {MAX_FRAMES:,}"))
    memory.hold(f"{frames:,} cameras", _CAMERA_BYTES * frames)


def opengl(pose: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Camera to world from OpenCV's axes (x right, y down, z ahead) in OpenGL's (x right, y up, z back)."""
    return combined(pose, _OPENCV)


def names_of(paths: Iterable[str | None]) -> list[str]:
    """A name for each frame that a file may have, all different: the last part of its path without a picture's ending.

    What is no letter, digit, space or one of .-_+()[] becomes _; a leading dot or dash, too. What is empty then is its
    number. Equal ones get their number behind them. A long one is cut.
    """
    taken: set[str] = set()
    found = []
    for i, path in enumerate(paths):
        name = plain = _safe(path or "") or f"{i:04d}"
        step = 0
        while name in taken:
            name, step = f"{plain}_{i:04d}" + "_" * step, step + 1
        taken.add(name)
        found.append(name)
    return found


def _safe(path: str) -> str:
    name = path.replace("\\", "/").rstrip("/").rpartition("/")[2]
    for ending in (*PICTURES, *_OTHERS):
        name = name.removesuffix(ending)
    name = _UNSAFE.sub("_", name[: 2 * MAX_NAME]).strip()
    if not name.strip("._-"):
        return ""
    name = "_" + name[1:] if name[0] in ".-" else name
    return name.encode()[:MAX_NAME].decode(errors="ignore").rstrip()


class PictureSizes:
    """Sizes from the headers of pictures that stand beside a file, each read once."""

    def __init__(self, folder: Folder | None) -> None:
        self._folder = folder
        self._known: dict[str, Size | None] = {}
        self._there: dict[str, set[str]] = {}  # the names in each folder: a capture may have 100,000 frames

    def of(self, path: str | None) -> Size | None:
        """Width and height of a picture, whose ending may be left out; None if it is not there or cannot be read."""
        inside = None if self._folder is None else inside_of(path)
        if not inside:
            return None
        if inside not in self._known:
            self._known[inside] = self._read(inside)
        return self._known[inside]

    def _read(self, path: str) -> Size | None:
        assert self._folder is not None
        # Imported here: only sizes need Pillow, and most files tell theirs.
        from nerfbake.formats.wire.picture import size_of

        place, _, name = path.rpartition("/")
        if place not in self._there:
            self._there[place] = set(self._folder.names(place))
        found = next((each for each in picture_names(name) if each in self._there[place]), None)
        if found is None:
            return None
        inside = f"{place}/{found}" if place else found
        try:
            return size_of(self._folder.head(inside), inside)
        except InvalidFile:
            return None


def inside_of(path: str | None) -> str:
    """The path as a name in the capture's own folder; '' for one that leads out of it, or that nothing can have."""
    if path is None or len(path) > _MAX_PATH or not path.isprintable():
        return ""
    parts = path.replace("\\", "/").split("/")
    if not parts[0] or ".." in parts or any(len(part.encode()) > _MAX_PART for part in parts):
        return ""
    return "/".join(part for part in parts if part not in ("", "."))


def size_note(frames: int, size: Size | None) -> tuple[str, ...]:
    """What is said where nothing tells how large the pictures of so many cameras are, and what is taken instead."""
    if not frames:
        return ()
    width, height = size or (DEFAULT_EDGE, DEFAULT_EDGE)
    whose = "the first" if size else "the Blender scenes"
    told = f"no size is told and no picture is there for {frames:,} of its cameras"
    return (f"{told}: {width}x{height} taken, as of {whose}",)
