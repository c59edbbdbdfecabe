"""nerf2mesh's stage 1, an atlas, or both -> the triangles that a page shows."""

from __future__ import annotations

from nerfbake import memory
from nerfbake.errors import InvalidScene, Problem
from nerfbake.scene.atlas import BakedAtlas
from nerfbake.scene.page_surface import PageSurface
from nerfbake.scene.stage1 import Stage1
from nerfbake.stages.stage1_to_image import surfaces

_COPIES = 4  # of everything, while a page is made of it: as it is, as bytes, packed, in base64


def build_page_surface(scene: Stage1 | BakedAtlas, *, stage1: Stage1 | None = None) -> PageSurface:
    """The scene's meshes with all that gives them their highlights.

    stage1: of an atlas the scene that it was baked from, for a page that shows both. Raises InvalidScene where a mesh
    or its diffuse texture is missing, or where the two are of different scenes; MemoryLimit.

    >>> from nerfbake import bake_stage1, build_page_surface, sample_stage1
    >>> stage1 = sample_stage1(resolution=16)
    >>> atlas = bake_stage1(stage1, clusters=4, map_size=8)
    >>> build_page_surface(atlas, stage1=stage1).highlights
    ('kmeans', 'mlp_constants', 'mlp_textures')
    """
    meshes = surfaces(scene)
    atlases = scene.atlases if isinstance(scene, BakedAtlas) else ()
    fields = scene.fields if isinstance(scene, Stage1) else stage1.fields if stage1 else ()
    if atlases and fields:
        _require_same(atlases[0].labels.shape, fields[0].features.shape[:2], len(atlases), len(fields))
    surface = PageSurface(meshes, atlases, fields)
    memory.require("the page's triangles and textures", _COPIES * memory.size_of(surface))
    return surface


def _require_same(labels: tuple[int, ...], features: tuple[int, ...], atlases: int, fields: int) -> None:
    """Raises InvalidScene for an atlas that was not baked from this stage 1, as far as sizes tell."""
    if (labels, atlases) != (features, fields):
        found = f"has {atlases} textures of {labels[1]}x{labels[0]} labels"
        allowed = f"{fields} of {features[1]}x{features[0]}, as the stage-1 scene has"
        raise InvalidScene(Problem("the atlas", found, allowed))
