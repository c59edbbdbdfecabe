"""Meshes as text of USD (.usda), with textures beside it; usd_stage.py describes the prims."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Literal

from nerfbake.formats.mesh.usd import decode, recognise
from nerfbake.formats.mesh.usd_stage import Image, mesh_stage, require_no_texture, stored, textures_of
from nerfbake.formats.wire.usd.text import encode_text
from nerfbake.scene.mesh import Meshes

__all__ = ["decode", "encode", "encode_files", "recognise", "stored"]


def encode(scene: Meshes, *, up: Literal["y", "z"] = "y", image: Image = "png") -> Iterator[bytes]:
    """Encode meshes without textures. Raises InvalidScene for textures, which encode_files() writes."""
    require_no_texture(scene)
    return encode_text(mesh_stage(scene, "", up=up, image=image))


def encode_files(
    scene: Meshes, stem: str, *, up: Literal["y", "z"] = "y", image: Image = "png"
) -> Iterator[tuple[str, Iterable[bytes]]]:
    """Yield the extension and the bytes of the layer, then those of each texture.

    up: the axis that points up; image: coding of the textures. Raises InvalidScene for levels of detail.
    """
    yield ".usda", encode_text(mesh_stage(scene, stem, up=up, image=image))
    for name, picture in textures_of(scene, stem, image):
        yield name.removeprefix(stem), [picture]
