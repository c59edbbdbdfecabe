"""nerf2mesh stage 1, MobileNeRF, or an atlas baked from them, and camera -> picture as in their viewers."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from nerfbake.errors import InvalidScene, Problem
from nerfbake.kernels.arrays import Singles
from nerfbake.kernels.surface.mlp import evaluate_each
from nerfbake.kernels.surface.texture import nearest_texel
from nerfbake.scene.atlas import BakedAtlas
from nerfbake.scene.camera import Camera
from nerfbake.scene.image import WHITE, Image
from nerfbake.scene.mesh import Mesh
from nerfbake.scene.stage1 import Stage1
from nerfbake.stages._supersampled import block_means, in_parts, mean_depth, supersampled
from nerfbake.stages._surface import Hits, SurfaceView, look_at_surfaces, shade_surfaces
from nerfbake.stages.meshes_to_image import surface_colours


def render_stage1(
    scene: Stage1 | BakedAtlas,
    camera: Camera,
    *,
    background: tuple[float, float, float] | None = WHITE,
    samples: int = 1,
) -> Image:
    """Render clamp(diffuse + specular) for each pixel, over a background (None: transparent).

    The specular colour of a Stage1 is the MLP's output. That of a BakedAtlas is computed like in atlas.glsl, with
    interpolation between the texels of a map. Both use the nearest texel of the texture, like the viewer of nerf2mesh
    (its renderer.html). samples x samples rays per pixel are averaged as in render_field(). Of a MobileNeRF scene their
    features and directions are averaged, 0 where a ray meets nothing; the MLP's output is then blended with the
    background by the share of rays that meet something, as in its viewer (with 2 x 2 rays). Raises InvalidScene if a
    mesh is missing. Source: docs/formats/atlas.md, "The stage-1 folder" and "MobileNeRF's folder".

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
    if isinstance(scene, Stage1) and scene.deferred:
        return _deferred(scene, meshes, camera, background, samples)
    return supersampled(lambda part: shade_surfaces(meshes, part, colours, background), camera, samples)


def surfaces(scene: Stage1 | BakedAtlas) -> tuple[Mesh, ...]:
    """Return the cascades' meshes. Raises InvalidScene if a mesh or its texture is missing."""
    found = []
    for cascade, mesh in enumerate(scene.meshes):
        if mesh is None or mesh.texture is None:
            name = f"shape{cascade}.obj" if isinstance(scene, Stage1) and scene.deferred else f"mesh_{cascade}.obj"
            what = name if mesh is None else f"feat0_{cascade}"
            raise InvalidScene(Problem(what, "is missing", "a mesh and its diffuse texture, to render pictures"))
        found.append(mesh)
    return tuple(found)


def _mlp(stage1: Stage1, cascade: int, hits: Hits) -> npt.NDArray[np.float32]:
    field = stage1.fields[cascade]
    return evaluate_each(nearest_texel(field.features, hits.uvs) / np.float32(255), hits.directions, *field.mlp)


def _deferred(
    stage1: Stage1,
    meshes: tuple[Mesh, ...],
    camera: Camera,
    background: tuple[float, float, float] | None,
    samples: int,
) -> Image:
    """Average directions and features of the rays of a pixel, and evaluate the MLP once."""

    def inputs(shape: int, hits: Hits) -> Singles:
        features = nearest_texel(stage1.fields[shape].features, hits.uvs) / np.float32(255)
        return np.concatenate([hits.directions, features], axis=1).astype(np.float32)

    def shade(seen: SurfaceView, N: int) -> Image:
        alpha, depth = mean_depth(seen.alpha, seen.depth, N)
        given, colour = block_means(seen.values, N), np.zeros((*alpha.shape, 3), np.float32)
        there = alpha > 0
        colour[there] = evaluate_each(given[there, 3:], given[there, :3], *stage1.fields[0].mlp)
        colour *= alpha[..., None]
        if background is not None:
            colour += (1 - alpha[..., None]) * np.array(background, np.float32)
        return Image(colour, alpha, depth, background)

    channels = 3 + stage1.fields[0].channels
    return in_parts(lambda part: look_at_surfaces(meshes, part, inputs, channels=channels), shade, camera, samples)


def _atlas(baked: BakedAtlas, cascade: int, hits: Hits) -> npt.NDArray[np.float32]:
    atlas = baked.atlases[cascade]
    features = None if atlas.features is None else nearest_texel(atlas.features, hits.uvs)
    return atlas.specular(nearest_texel(atlas.labels, hits.uvs), features, hits.directions)
