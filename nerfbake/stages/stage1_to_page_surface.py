"""nerf2mesh stage 1, an atlas, both, or plain meshes -> the meshes, textures and MLPs that a page displays."""

from __future__ import annotations

from nerfbake import memory
from nerfbake.errors import InvalidScene, Problem
from nerfbake.scene.atlas import BakedAtlas
from nerfbake.scene.mesh import Meshes
from nerfbake.scene.page import PageSurface
from nerfbake.scene.stage1 import Stage1
from nerfbake.stages.stage1_to_image import surfaces

_COPIES = 4  # copies of all data while a page is written: the arrays, their bytes, compressed, in base64


def build_page_surface(scene: Stage1 | BakedAtlas | Meshes, *, stage1: Stage1 | None = None) -> PageSurface:
    """Return the scene's meshes with all data for their highlights, if it has any.

    stage1: for an atlas, the scene that it was baked from, for a page that displays both. Raises InvalidScene if a mesh
    or its diffuse texture is missing, or if the two do not belong to the same scene; MemoryLimit.

    >>> from nerfbake import bake_stage1, build_page_surface, sample_stage1
    >>> stage1 = sample_stage1(resolution=16)
    >>> atlas = bake_stage1(stage1, clusters=4, map_size=8)
    >>> build_page_surface(atlas, stage1=stage1).highlights
    ('kmeans', 'mlp_constants', 'mlp_textures')
    """
    meshes = scene.meshes if isinstance(scene, Meshes) else surfaces(scene)
    atlases = scene.atlases if isinstance(scene, BakedAtlas) else ()
    fields = scene.fields if isinstance(scene, Stage1) else stage1.fields if stage1 else ()
    if atlases and fields:
        _require_same(atlases[0].labels.shape, fields[0].features.shape[:2], len(atlases), len(fields))
    surface = PageSurface(meshes, atlases, fields)
    memory.require("the page's triangles and textures", _COPIES * memory.size_of(surface))
    return surface


def _require_same(labels: tuple[int, ...], features: tuple[int, ...], atlases: int, fields: int) -> None:
    """Raise InvalidScene if the sizes show that an atlas was not baked from this stage 1."""
    if (labels, atlases) != (features, fields):
        found = f"has {atlases} textures of {labels[1]}x{labels[0]} labels"
        allowed = f"{fields} of {features[1]}x{features[0]}, as the stage-1 scene has"
        raise InvalidScene(Problem("the atlas", found, allowed))
