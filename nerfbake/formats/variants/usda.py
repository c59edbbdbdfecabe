"""Representations of a scene as variants of a stage, as text of USD (.usda), with textures and a .vdb beside it.

Written only; usd_stage.py describes the prims.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from nerfbake.errors import InvalidScene, Problem
from nerfbake.formats.variants.usd_stage import inline, pictures_of, stage_of, variant_stage, volume_of
from nerfbake.formats.volume import openvdb
from nerfbake.formats.volume.usd_stage import VDB
from nerfbake.formats.wire.usd.stage import UsdVariant
from nerfbake.formats.wire.usd.text import encode_text
from nerfbake.scene.mesh import Meshes
from nerfbake.scene.scene_variants import SceneVariants


def encode(scene: SceneVariants) -> Iterator[bytes]:
    """Encode representations that need no other files. Raises InvalidScene for textures and a volume."""
    if volume_of(scene) is not None:
        raise InvalidScene(Problem("the volume", "needs a .vdb beside the stage", "a file on the disk"))
    meshes = [mesh for each in scene.variants if isinstance(each.scene, Meshes) for mesh in each.scene.meshes]
    if any(mesh.texture is not None for mesh in meshes):
        raise InvalidScene(Problem("the mesh", "has a texture", ".usdz, or a file on the disk"))
    return _layer(scene, "")


def encode_files(scene: SceneVariants, stem: str) -> Iterator[tuple[str, Iterable[bytes | memoryview]]]:
    """Yield extension and bytes of the layer, then those of each texture and of the .vdb. Raises InvalidScene."""
    yield ".usda", _layer(scene, stem)
    for name, picture in pictures_of(scene, stem):
        yield name.removeprefix(stem), [picture]
    if (volume := volume_of(scene)) is not None:
        yield VDB, openvdb.encode(volume)


def _layer(scene: SceneVariants, stem: str) -> Iterator[bytes]:
    variants: dict[str, UsdVariant] = {each.name: inline(stage_of(each, stem)) for each in scene.variants}
    return encode_text(variant_stage(scene, variants))
