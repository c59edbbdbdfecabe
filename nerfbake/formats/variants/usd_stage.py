"""Representations of a scene as variants of the default prim of a stage, which the writers of both containers share.

    Xform "scene"                    variantSet "representation": splats, mesh, volume; the first one is selected
        the prims of the variant     those of formats/splat/usd.py, mesh/usd_stage.py or volume/usd_stage.py
                                     customData of the variant: dictionary nerfbake: double psnr, string content

y is up in the stage, which has one up axis for all variants.
Source: OpenUSD 26.11, "Variants" of the glossary.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import cast

from nerfbake.formats.mesh.usd_stage import mesh_stage, textures_of
from nerfbake.formats.splat.usd import splat_stage
from nerfbake.formats.volume.usd_stage import volume_stage
from nerfbake.formats.wire.usd.content import VARIANTS
from nerfbake.formats.wire.usd.stage import Prim, UsdStage, UsdVariant
from nerfbake.scene.mesh import Meshes
from nerfbake.scene.scene_variants import SceneVariant, SceneVariants
from nerfbake.scene.splats import Splats
from nerfbake.scene.volume import Volume


def stage_of(variant: SceneVariant, stem: str) -> UsdStage:
    """Return the stage of one representation, with y up. stem: of the names of files that it refers to."""
    scene = variant.scene
    if isinstance(scene, Splats):
        return splat_stage(scene.with_up("z") if scene.up == "z" else scene)
    if isinstance(scene, Meshes):
        return mesh_stage(scene, stem, up="z", image="png")
    return volume_stage(scene, stem, up="y")


def variant_stage(scene: SceneVariants, variants: Mapping[str, UsdVariant]) -> UsdStage:
    """Return the stage of these variants, with the loss of each."""
    told: dict[str, UsdVariant] = {
        each.name: variants[each.name]._replace(facts={"psnr": each.psnr, "content": str(each.scene)})
        for each in scene.variants
    }
    return UsdStage(Prim("scene", "Xform", variant_set=VARIANTS, variants=told), "Y")


def inline(stage: UsdStage) -> UsdVariant:
    """Return the root prim of a stage as a variant, with its properties and children."""
    return UsdVariant(stage.root.properties, stage.root.children)


def pictures_of(scene: SceneVariants, stem: str) -> list[tuple[str, bytes]]:
    """Return the names and bytes of the textures of the meshes."""
    meshes = [variant.scene for variant in scene.variants if isinstance(variant.scene, Meshes)]
    return [picture for each in meshes for picture in textures_of(each, stem, "png")]


def volume_of(scene: SceneVariants) -> Volume | None:
    """Return the volume among the representations."""
    return next((cast(Volume, each.scene) for each in scene.variants if each.name == "volume"), None)
