"""Meshes as glTF 2.0 in one file (.glb). Coordinates are the field's own: nothing is turned, whatever axis is up."""

from __future__ import annotations

from typing import Literal

from nerfbake.formats.mesh.glb_reader import decode_glb
from nerfbake.formats.mesh.glb_writer import Part, encode_glb
from nerfbake.formats.wire.texture import encode_texture
from nerfbake.scene.mesh import Mesh, Meshes


def recognise(view: memoryview) -> bool:
    """True for glTF's magic number."""
    return bytes(view[:4]) == b"glTF"


def encode(scene: Meshes, *, up: Literal["y", "z"] = "y") -> list[bytes | memoryview]:
    """up: the scene's axis that points up; glTF's is y."""
    return encode_glb([_part(number, mesh) for number, mesh in enumerate(scene.meshes)], "nerfbake", up=up)


def decode(view: memoryview) -> Meshes:
    """Raises InvalidFile for what is not sound or needs another file, InvalidScene for values that no mesh can have."""
    return Meshes(decode_glb(view))


def _part(number: int, mesh: Mesh) -> Part:
    textures = {} if mesh.texture is None else {"diffuse": encode_texture(mesh.texture)}
    return Part(f"mesh {number}", mesh, textures)
