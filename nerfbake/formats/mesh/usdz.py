"""Meshes as a package of USD (.usdz) with one crate and its textures; usd_stage.py describes the prims."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Literal

from nerfbake.formats.mesh.usd import meshes_of, recognise
from nerfbake.formats.mesh.usd_stage import Image, mesh_stage, stored, textures_of
from nerfbake.formats.wire.usd.package import package_stage
from nerfbake.formats.wire.usd.reading import read_stage
from nerfbake.scene.mesh import Meshes

__all__ = ["decode", "encode", "recognise", "stored"]
_STEM = "texture"


def encode(scene: Meshes, *, up: Literal["y", "z"] = "y", image: Image = "png") -> Iterator[bytes | memoryview]:
    """Encode meshes. up: the axis that points up; image: coding of the textures. Raises InvalidScene."""
    stage = mesh_stage(scene, _STEM, up=up, image=image)
    textures = [(name, [picture]) for name, picture in textures_of(scene, _STEM, image)]
    return package_stage(stage, textures)


def decode(view: memoryview) -> Meshes:
    """Read the meshes of a package. Raises UsageError without OpenUSD, InvalidFile, InvalidScene, MemoryLimit."""
    return meshes_of(read_stage(view))
