"""Representations of a scene as variants of a stage, as a package of USD (.usdz).

The first file is a layer of text, whose variants refer to a crate each. Written only; usd_stage.py describes the prims.
"""

from __future__ import annotations

from collections.abc import Iterator

from nerfbake.errors import InvalidScene, Problem
from nerfbake.formats.variants.usd_stage import pictures_of, stage_of, variant_stage, volume_of
from nerfbake.formats.wire.usd.crate import encode_crate
from nerfbake.formats.wire.usd.package import encode_package
from nerfbake.formats.wire.usd.stage import UsdVariant
from nerfbake.formats.wire.usd.text import encode_text
from nerfbake.scene.scene_variants import SceneVariants

_STEM = "texture"


def encode(scene: SceneVariants) -> Iterator[bytes | memoryview]:
    """Encode splats and meshes. Raises InvalidScene for a volume, which a package must not contain."""
    if volume_of(scene) is not None:
        raise InvalidScene(Problem("the volume", "cannot be in a .usdz", ".usda"))
    layers = [(f"{each.name}.usdc", list(encode_crate(stage_of(each, _STEM)))) for each in scene.variants]
    variants: dict[str, UsdVariant] = {
        each.name: UsdVariant(reference=f"./{each.name}.usdc") for each in scene.variants
    }
    root = list(encode_text(variant_stage(scene, variants)))
    pictures = [(name, [picture]) for name, picture in pictures_of(scene, _STEM)]
    return encode_package([("scene.usda", root), *layers, *pictures])
