"""nerf2mesh's stage 1, or the atlas baked from it, and camera -> picture: what a viewer of either would show."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from nerfbake.errors import InvalidScene, Problem
from nerfbake.kernels.surface.mlp import evaluate_each
from nerfbake.kernels.surface.texture import nearest_texel
from nerfbake.scene.atlas import BakedAtlas
from nerfbake.scene.camera import Camera
from nerfbake.scene.image import WHITE, Image
from nerfbake.scene.mesh import Mesh
from nerfbake.scene.stage1 import Stage1
from nerfbake.stages._supersampled import supersampled
from nerfbake.stages._surface import Hits, paint
from nerfbake.stages.meshes_to_image import surface_colours


def render_stage1(
    scene: Stage1 | BakedAtlas,
    camera: Camera,
    *,
    background: tuple[float, float, float] | None = WHITE,
    samples: int = 1,
) -> Image:
    """clamp(diffuse + specular) at each pixel, over a background (None: transparent).

    Of a Stage1 specular is the MLP, of a BakedAtlas it is what atlas.glsl shows; both at the nearest texel, as the
    viewer of nerf2mesh (its renderer.html) has it, maps between texels. samples x samples rays a pixel are averaged as
    render_field() does it. Raises InvalidScene where a mesh is missing.
    Source: docs/formats/atlas.md, "The stage-1 folder".

    >>> from nerfbake import orbit_cameras, render_stage1, sample_stage1
    >>> stage1 = sample_stage1(resolution=16)
    >>> image = render_stage1(stage1, orbit_cameras(stage1, width=16, height=12).cameras[0])
    >>> image.size, bool(image.alpha.max() == 1)
    ((16, 12), True)
    """

    def colours(cascade: int, hits: Hits) -> npt.NDArray[np.float32]:
        specular = _mlp(scene, cascade, hits) if isinstance(scene, Stage1) else _atlas(scene, cascade, hits)
        return np.asarray(np.clip(surface_colours(hits) + specular, 0, 1), np.float32)

    meshes = surfaces(scene)
    return supersampled(lambda part: paint(meshes, part, colours, background), camera, samples)


def surfaces(scene: Stage1 | BakedAtlas) -> tuple[Mesh, ...]:
    """The cascades' meshes. Raises InvalidScene if one has none, or no texture."""
    found = []
    for cascade, mesh in enumerate(scene.meshes):
        if mesh is None or mesh.texture is None:
            what = f"mesh_{cascade}.obj" if mesh is None else f"feat0_{cascade}"
            raise InvalidScene(Problem(what, "is missing", "a mesh and its diffuse texture, where there are pictures"))
        found.append(mesh)
    return tuple(found)


def _mlp(stage1: Stage1, cascade: int, hits: Hits) -> npt.NDArray[np.float32]:
    field = stage1.fields[cascade]
    return evaluate_each(nearest_texel(field.features, hits.uvs) / np.float32(255), hits.directions, field.w0, field.w1)


def _atlas(baked: BakedAtlas, cascade: int, hits: Hits) -> npt.NDArray[np.float32]:
    atlas = baked.atlases[cascade]
    features = None if atlas.features is None else nearest_texel(atlas.features, hits.uvs)
    return atlas.specular(nearest_texel(atlas.labels, hits.uvs), features, hits.directions)
