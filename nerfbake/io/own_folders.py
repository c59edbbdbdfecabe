"""Which folders an output may replace: those that contain nothing but files of its own kind.

A folder that is the working folder, the home folder or an input, or that contains one of them, is never replaced.
Folders are compared by device and inode: links, `..` and other spellings of a path make no difference.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from nerfbake.catalog import FolderKind
from nerfbake.errors import OutputError
from nerfbake.io.sources import STREAM, Folder

_DEPTH = 2  # folders in each other that nerfbake writes, the output included


class FolderContents(NamedTuple):
    """The contents of the folders of one kind.

    title      the kind, for errors
    files      the relative paths of all files that nerfbake writes
    recognise  whether a folder that contains only such files is of this kind
    """

    title: str
    files: re.Pattern[str]
    recognise: Callable[[Mapping[str, memoryview]], bool]

    @staticmethod
    def of(kind: FolderKind) -> FolderContents:
        """The contents of a kind of folder in the catalog."""
        module = kind.load_module()
        return FolderContents(kind.title, module.FILES, module.recognise)

    def problem(self, folder: Path) -> str | None:
        """Return why a folder must not be replaced, or None. An empty folder may be replaced. Raises OSError."""
        if (foreign := self._foreign(folder)) is not None:
            return f"has {foreign!r}, which nerfbake did not write"
        if any(folder.iterdir()) and not self.recognise(Folder(folder, {})):
            return f"is not {self.title}, although all its names are those of one"
        return None

    def _foreign(self, folder: Path, above: str = "", depth: int = 1) -> str | None:
        """Return the path of the first entry that nerfbake does not write; None if there is none.

        Links, pipes and empty subfolders are such entries.
        """
        for entry in sorted(os.scandir(folder), key=lambda entry: entry.name):
            path = above + entry.name
            if entry.is_dir(follow_symlinks=False):
                inner = Path(entry.path)
                if depth == _DEPTH or not any(inner.iterdir()):
                    return path
                if (foreign := self._foreign(inner, f"{path}/", depth + 1)) is not None:
                    return foreign
            elif not entry.is_file(follow_symlinks=False) or not self.files.fullmatch(path):
                return path
        return None


def require_apart(folder: Path, inputs: Sequence[str]) -> None:
    """Raise OutputError if a folder is or contains the working folder, the home folder or an input."""
    try:
        own = folder.stat()
    except OSError:
        return  # what does not exist contains nothing
    home = os.path.expanduser("~")  # noqa: PTH111 - Path.expanduser() raises if there is none
    places = [(os.curdir, "the working folder"), (home, "the home folder")]
    places += [(path, f"the input {path}") for path in inputs if path != STREAM]
    for path, text in places:
        for found, place in _around(Path(path)):
            with suppress(OSError, ValueError):
                if os.path.samestat(place.stat(), own):
                    raise OutputError(f"{found} {text}; allowed: another folder", source=str(folder))


def _around(path: Path) -> Iterator[tuple[str, Path]]:
    """Yield a path and the folders around it, and around what it links to, with what a folder there would be to it."""
    yield "is", path
    for resolve in (os.path.realpath, os.path.abspath):
        with suppress(OSError, ValueError):
            yield from (("contains", place) for place in Path(resolve(path)).parents)
