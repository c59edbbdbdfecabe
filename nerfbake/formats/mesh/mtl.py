r"""Read and write the materials of .obj files (.mtl): names, and the pictures of their diffuse colours.

    newmtl NAME     map_Kd [-option value ...] PICTURE     map_d PICTURE

Pictures are PNG or JPEG beside the .obj or in a folder below it, with / or \ in their names. Other pictures and missing
files are left out with a note, as are names that lead out of the folder of the .obj, by .., from the root or through a
link in a folder below: a file from elsewhere must not choose what is read. With a map_d, an alpha below 1/2 in the
picture of map_Kd is a hole, whatever picture map_d names. Names may contain spaces and #; a line that
starts with # is a comment. Options of a picture are skipped.
"""

from __future__ import annotations

import re
from codecs import BOM_UTF8
from collections.abc import Container, Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from nerfbake.errors import InvalidFile, Problem
from nerfbake.formats.wire.picture import decode_cut_out

Texture = tuple[npt.NDArray[np.uint8], npt.NDArray[np.bool_] | None]
_ENDINGS = (".png", ".jpg", ".jpeg")
_LONGEST = 200  # bytes of a file name
_MOST = 100  # names of libraries
_TOLD = 60  # characters of a name in a note
_NUMBER = rb"[-+]?[.0-9]++(?:e[-+]?[0-9]++)?"
_OPTIONS = re.compile(
    rb"\A(?:-(?:imfchan|type)\s++\S++\s++|-[a-z]++\s++(?:(?:on|off|%b)\s++)*+)++" % _NUMBER, re.IGNORECASE
)
_PLACING = re.compile(rb"-[ost]\s", re.IGNORECASE)  # options that move or scale the picture
_MTL = "newmtl {}\nKa 1 1 1\nKd 1 1 1\nKs 0 0 0\nTr 1\nillum 1\nNs 0\n"


class Materials:
    """The textures of the materials in the libraries beside an .obj; each picture is decoded once.

    libraries: what each mtllib line names. The first library that has a material counts. Libraries and pictures that
    are left out become a note. Raises InvalidFile for more than 100 libraries.
    """

    def __init__(self, libraries: Iterable[bytes], beside: Mapping[str, memoryview] | None) -> None:
        self._beside = {} if beside is None else beside
        self._left: dict[str, None] = {}  # what is left out, and why
        # By material: the folder of its library, its line, and whether the picture has holes.
        self._pictures: dict[bytes, tuple[str, bytes, bool]] = {}
        for name in self._names(libraries):
            folder = name[: name.rfind("/") + 1]
            found = _pictures(bytes(self._beside[name]))
            self._pictures = {material: (folder, *line) for material, line in found.items()} | self._pictures
        self._textures: dict[str, Texture] = {}

    @property
    def notes(self) -> tuple[str, ...]:
        """A line about the first library or picture that is left out, if any, with the number of the others."""
        first, more = next(iter(self._left), None), len(self._left) - 1
        return () if first is None else (first + (f" (and {more:,} more)" if more else ""),)

    def texture(self, material: bytes, *, placed: bool = True) -> Texture | tuple[None, None]:
        """The texture (H, W, 3) of a material and its texels that are no holes (H, W); None if it has none.

        placed: the mesh has texture coordinates. Without them, its texture is left out. Raises InvalidFile,
        MemoryLimit.
        """
        folder, line, holed = self._pictures.get(material, ("", b"", False))
        named = _OPTIONS.sub(b"", line)  # a name may contain spaces
        name = self._there(named, folder)
        if name is None or not name.lower().endswith(_ENDINGS):
            if named:
                self._leave("texture", named, "is no PNG or JPEG in the folder of the .obj")
            return None, None
        if not placed:
            self._leave("texture", named, "is not shown, because corners lack texture coordinates")
            return None, None
        if _PLACING.search(line[: len(line) - len(named)]):
            self._leave("texture", line, "is shown without its options")
        if name not in self._textures:
            self._textures[name] = decode_cut_out(self._beside[name], name)
        texels, opaque = self._textures[name]
        return texels, opaque if holed else None

    def _leave(self, what: str, name: bytes, reason: str) -> None:
        self._left[f"{what} {name.decode(errors='replace')[:_TOLD]!r} {reason}"] = None

    def _names(self, libraries: Iterable[bytes]) -> list[str]:
        """The names of the libraries that are there. A line names one, whose name may contain spaces, or several."""
        lines: set[bytes] = set()
        found: dict[bytes, str | None] = {}
        for line in libraries:
            if line in lines:
                continue
            lines.add(line)
            names = [line] if self._there(line) else line.split(None, _MOST)
            there = {name: self._there(name) for name in names}
            if not any(there.values()):
                self._leave("mtllib", line, "is not in the folder of the .obj, so that its materials are not known")
            found |= there
            if max(len(lines), len(found)) > _MOST:
                raise InvalidFile(Problem("mtllib", f"names more than {_MOST} libraries", f"{_MOST} at most"))
        return [name for name in dict.fromkeys(found.values()) if name]

    def _there(self, name: bytes | None, folder: str = "") -> str | None:
        """The path of a file from the folder of the .obj, as the system spells it; None if it names none, or leads out.

        folder: where the name is looked for first. A file beside the .obj may be a link to elsewhere: whoever made the
        folder put it there under this name. `holds`, which a folder on the disk has, follows the links below it.
        """
        path = (name or b"").replace(b"\\", b"/")
        parts = [part for part in path.split(b"/") if part not in (b"", b".")]
        if not parts or len(path) > _LONGEST or b".." in parts or path.startswith(b"/") or b"\0" in path:
            return None
        plain = "/".join(part.decode("utf-8", "surrogateescape") for part in parts)
        holds = getattr(self._beside, "holds", self._beside.__contains__)
        for found in dict.fromkeys((folder + plain, plain)):
            if found in self._beside and ("/" not in found or holds(found)):
                return found
        return None


def _pictures(content: bytes) -> dict[bytes, tuple[bytes, bool]]:
    """The picture of each material, behind its options, b"" for none; and whether it has holes."""
    found: dict[bytes, tuple[bytes, bool]] = {}
    material = b""
    for line in content.removeprefix(BOM_UTF8).splitlines():
        word, rest = (*line.split(None, 1), b"", b"")[:2]
        rest = rest.strip()
        if word == b"newmtl":
            material = rest
            found.setdefault(material, (b"", False))
        if word.lower() == b"map_kd" and rest:
            found[material] = rest, found.get(material, (b"", False))[1]
        if word.lower() == b"map_d" and rest:
            found[material] = found.get(material, (b"", False))[0], True
    return found


def encode_mtl(materials: Sequence[tuple[str, str | None]], holed: Container[str] = ()) -> bytes:
    """The library of these materials: the name of each, and of its picture or None. holed: materials with holes."""
    lines: list[Any] = []
    for name, picture in materials:
        lines.append(_MTL.format(name) + (f"map_Kd {picture}\n" if picture else ""))
        lines.append(f"map_d {picture}\n" if name in holed else "")
    return "".join(lines).encode("utf-8", "surrogateescape")
