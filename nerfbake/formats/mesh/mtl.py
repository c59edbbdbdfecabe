"""Read and write the materials of .obj files (.mtl): names, and the pictures of their diffuse colours.

    newmtl NAME     map_Kd [-option value ...] PICTURE

Pictures stand beside the .obj as PNG or JPEG. Other pictures and missing files are ignored, as are names with a folder:
a file from elsewhere must not choose what is read.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from nerfbake import memory
from nerfbake.formats.wire.picture import decode_texture

_ENDINGS = (".png", ".jpg", ".jpeg")
_LONGEST = 200  # bytes of a file name
_MTL = "newmtl {}\nKa 1 1 1\nKd 1 1 1\nKs 0 0 0\nTr 1\nillum 1\nNs 0\n"


class Materials:
    """The textures of the materials in a library beside an .obj; each picture is decoded once."""

    def __init__(self, library: bytes | None, beside: Mapping[str, memoryview] | None) -> None:
        self._beside = {} if beside is None else beside
        self._pictures = _pictures(self._file(library) or b"")
        self._textures: dict[str, npt.NDArray[np.uint8]] = {}

    def texture(self, material: bytes) -> npt.NDArray[np.uint8] | None:
        """The texture (H, W, 3) of a material; None if it has none. Raises InvalidFile, MemoryLimit."""
        name = _plain(self._pictures.get(material))
        if name is None or not name.lower().endswith(_ENDINGS) or name not in self._beside:
            return None
        if name not in self._textures:
            texture = decode_texture(self._beside[name], name, any_mode=True)
            memory.hold(name, texture.nbytes)
            self._textures[name] = texture
        return self._textures[name]

    def _file(self, name: bytes | None) -> bytes | None:
        plain = _plain(name)
        return bytes(self._beside[plain]) if plain is not None and plain in self._beside else None


def _plain(name: bytes | None) -> str | None:
    """A file name without a folder, as the system spells it; None if it is none."""
    if not name or len(name) > _LONGEST or b"/" in name or b"\\" in name or b"\0" in name or name in (b".", b".."):
        return None
    return name.decode("utf-8", "surrogateescape")


def _pictures(content: bytes) -> dict[bytes, bytes]:
    """The picture of each material that has one."""
    found, material = {}, b""
    for line in content.splitlines():
        word, _, rest = line.strip().partition(b" ")
        if word == b"newmtl":
            material = rest.strip()
        if word == b"map_Kd" and rest.split():
            # Options come before the name, which may contain spaces.
            found[material] = rest.split()[-1] if rest.strip().startswith(b"-") else rest.strip()
    return found


def encode_mtl(materials: Sequence[tuple[str, str | None]]) -> bytes:
    """The library of these materials: the name of each, and of its picture or None."""
    lines: list[Any] = [_MTL.format(name) + (f"map_Kd {picture}\n" if picture else "") for name, picture in materials]
    return "".join(lines).encode("utf-8", "surrogateescape")
