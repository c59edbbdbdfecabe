"""Meshes as Wavefront text (.obj): positions, texture coordinates, vertex colours, faces.

Coordinates are the field's own. Textures would stand in other files, named by a third: they are neither read nor
written; .glb has them inside.
"""

from __future__ import annotations

import re
from collections.abc import Iterator

from nerfbake.contract import HEAD
from nerfbake.errors import InvalidScene, Problem
from nerfbake.formats.mesh.obj_reader import decode_obj
from nerfbake.formats.mesh.obj_writer import encode_obj
from nerfbake.scene.mesh import Meshes

_KEYWORD = re.compile(rb"^(v|vt|vn|mtllib|o|g|usemtl) ", re.MULTILINE)


def recognise(view: memoryview) -> bool:
    """True for text with a line such as an .obj starts with."""
    head = bytes(view[:HEAD])
    return b"\0" not in head and _KEYWORD.search(head) is not None


def encode(scene: Meshes) -> Iterator[bytes]:
    """Raises InvalidScene for meshes with textures."""
    if any(mesh.texture is not None for mesh in scene.meshes):
        raise InvalidScene(Problem("the mesh", "has a texture", "meshes without textures, or .glb"))
    return encode_obj(scene.meshes)


def decode(view: memoryview) -> Meshes:
    """Raises InvalidFile for what cannot be read or has no faces, InvalidScene for values that no mesh can have."""
    return Meshes(decode_obj(view, "the mesh"))
