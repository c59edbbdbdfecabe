"""Shared parts of the camera readers: the files of a folder, safe file names, sizes read from pictures."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Iterable
from contextlib import suppress

import numpy as np
import numpy.typing as npt

from nerfbake import memory
from nerfbake.contract import PICTURES, HeadedFiles, composed_name, picture_names
from nerfbake.errors import InvalidFile, Problem
from nerfbake.kernels.maths.affine import compose

MAX_FRAMES = 100_000
DEFAULT_EDGE = 800  # pixels, the size of the Blender scenes
MAX_NAME = 120  # bytes of a name, which leaves room for suffixes of additional and temporary files
_UNSAFE = re.compile(r"[^\w .+()\[\]-]")
_OTHERS = (".webp", ".exr", ".tif", ".tiff", ".bmp", ".hdr")
_MAX_PATH = 1000  # characters
_MAX_PART = 255  # characters of a name: Linux has up to 255 bytes, macOS and Windows 255 words of UTF-16
_CAMERA_BYTES = 1000  # memory of one Camera object
# Bytes of a picture that are read to find its size: enough for a thumbnail and a colour profile, which precede it; then
# for the depth map and the second picture of a phone's portrait, which may also precede it.
_HEADS = 1 << 18, 1 << 25
_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])

Size = tuple[int, int]
CaptureFolder = HeadedFiles  # files by name, read on access; a name may contain subfolders


def room_for(frames: int) -> None:
    """Raise InvalidFile for no frames or too many, MemoryLimit if their cameras do not fit."""
    if not 1 <= frames <= MAX_FRAMES:
        raise InvalidFile(Problem("the frames", f"are {frames:,}", f"1 to {MAX_FRAMES:,}"))
    memory.hold(f"{frames:,} cameras", _CAMERA_BYTES * frames)


def opengl(pose: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Convert a pose from OpenCV's axes (x right, y down, z forward) to OpenGL's (x right, y up, z back)."""
    return compose(pose, _OPENCV)


def names_of(paths: Iterable[str | None]) -> list[str]:
    """Return a unique, safe file name for each frame: the last part of its path without a picture extension.

    The name is composed. Characters other than letters, digits, spaces and .-_+()[] become _, and so does a leading dot
    or dash. A frame without a name gets its number. Equal names get their number as a suffix. Long names are truncated.
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
    name = _UNSAFE.sub("_", composed_name(name[: 2 * MAX_NAME])).strip()
    if not name.strip("._-"):
        return ""
    name = "_" + name[1:] if name[0] in ".-" else name
    return name.encode()[:MAX_NAME].decode(errors="ignore").rstrip()


class PictureSizes:
    """Sizes from the headers of the pictures of a capture; each header is read once.

    unreadable: the first picture that exists, but whose size cannot be read; '' if there is none
    """

    def __init__(self, folder: CaptureFolder | None) -> None:
        self.unreadable = ""
        self._folder = folder
        self._known: dict[str, Size | None] = {}
        # Names by folder and composed name, cached because a capture may have 100,000 frames.
        self._there: dict[str, dict[str, str]] = {}

    def of(self, path: str | None) -> Size | None:
        """Return width and height of a picture, or None if it is missing or unreadable. The extension is optional."""
        inside = None if self._folder is None else inside_of(path)
        if not inside:
            return None
        if inside not in self._known:
            self._known[inside] = self._read(inside)
        return self._known[inside]

    def _read(self, path: str) -> Size | None:
        assert self._folder is not None
        # Imported here: only this function needs Pillow, and most files contain the sizes.
        from nerfbake.formats.wire.picture import is_photograph, size_of

        place, _, name = path.rpartition("/")
        if place not in self._there:
            names = self._folder.names(place)
            self._there[place] = {composed_name(each): each for each in names} | {each: each for each in names}
        there = self._there[place]
        stored = (there.get(each) or there.get(composed_name(each)) for each in picture_names(name))
        found = next((each for each in stored if each), None)
        if found is None:
            return None
        inside = f"{place}/{found}" if place else found
        for most in _HEADS:
            head = self._folder.head(inside, most)
            with suppress(InvalidFile):
                return size_of(head, inside)
            if len(head) < most or not is_photograph(memoryview(head)):
                break
        self.unreadable = self.unreadable or inside
        return None


def visible_names(files: CaptureFolder, folder: str, endings: str | tuple[str, ...]) -> list[str]:
    """Return the names of the files in a subfolder with one of these extensions, sorted, without hidden ones.

    macOS writes a hidden file ._NAME beside each file on drives of other systems.
    """
    return [name for name in files.names(folder) if name.endswith(endings) and not name.startswith(".")]


def inside_of(path: str | None) -> str:
    """Normalise a path inside the capture's folder; '' for a path that leaves the folder or is invalid."""
    if path is None or len(path) > _MAX_PATH or not _is_shown(path):
        return ""
    parts = path.replace("\\", "/").split("/")
    if not parts[0] or ".." in parts or any(len(part) > _MAX_PART for part in parts):
        return ""
    return "/".join(part for part in parts if part not in ("", "."))


def _is_shown(path: str) -> bool:
    """Return whether all characters can be printed. Spaces of any width can, as in the names of macOS's screenshots."""
    return path.isprintable() or all(char.isprintable() or unicodedata.category(char) == "Zs" for char in path)


def size_note(frames: int, size: Size | None, unreadable: str) -> tuple[str, ...]:
    """Return the note for cameras without a known size.

    size: used instead, None for the default; unreadable: a picture whose size cannot be read, '' if there is none
    """
    if not frames:
        return ()
    width, height = size or (DEFAULT_EDGE, DEFAULT_EDGE)
    source = "the first picture" if size else "the Blender scenes"
    of = f"{frames:,} of its cameras"
    missing = f"no readable picture for {of} ({unreadable} cannot be read)" if unreadable else f"no picture for {of}"
    return (f"no size and {missing}; using {width}x{height}, the size of {source}",)
