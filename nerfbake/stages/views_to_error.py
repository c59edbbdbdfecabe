"""Radiance field, meshes or splats, and views -> the error of their pictures against the photographs."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from typing import NamedTuple

import numpy as np

from nerfbake import memory, progress
from nerfbake.kernels.arrays import Floats, Singles
from nerfbake.kernels.parallel import in_order
from nerfbake.kernels.picture.metrics import psnr, ssim
from nerfbake.scene.image import Image
from nerfbake.scene.mesh import Meshes
from nerfbake.scene.radiance_field import RadianceField
from nerfbake.scene.splats import Splats
from nerfbake.scene.stage1 import Stage1
from nerfbake.scene.views import Views
from nerfbake.stages.meshes_to_image import render_meshes
from nerfbake.stages.renderers import KERNELS, Renderer
from nerfbake.stages.stage1_to_image import render_stage1

Measured = RadianceField | Meshes | Stage1 | Splats

_PIXEL_BYTES = 280  # per pixel while two pictures are compared, as in scenes_to_comparison


class ViewError(NamedTuple):
    """The error of a view's picture against its photograph.

    name: of the camera. psnr in dB, and ssim: of the picture as it is. corrected: PSNR in dB of the picture times the
    gain of each channel that makes it most similar to the photograph, which removes differences of exposure and of
    white balance.
    """

    name: str
    psnr: float
    ssim: float
    corrected: float


def plain_psnr(views: Views) -> float:
    """Return the mean PSNR in dB of pictures that have only the mean colour of their photograph.

    >>> import numpy as np
    >>> from nerfbake import Camera, Cameras, Views
    >>> picture = np.full((2, 4, 4), 255, np.uint8)
    >>> picture[0, :, :3] = 0
    >>> camera = Camera(4, 2, 5.0, np.eye(4), "front")
    >>> round(plain_psnr(Views(Cameras((camera,)), (picture,), (1.0, 1.0, 1.0), False)), 2)
    6.02
    """

    def of_view(number: int) -> float:
        truth = views.photograph(number)[views.used(number)].astype(np.float64)
        return psnr(np.broadcast_to(truth.mean(axis=0), truth.shape), truth)

    return sum(in_order(partial(of_view, number) for number in range(len(views.pictures)))) / len(views.pictures)


def measure_views(
    scene: Measured, views: Views, *, samples: int = 1, render: Renderer = KERNELS
) -> tuple[ViewError, ...]:
    """Render every view over its background, and measure it against its photograph.

    Vertex colours of meshes are shown as they are, without light. samples: as in render_field(); no effect on splats.
    render: renders fields and splats.
    Errors are on sRGB in 0..1, before rounding to 8 bits, as in compare_scenes(). Raises InvalidScene for lenses that
    do not cover their pictures, MemoryLimit.

    >>> import numpy as np
    >>> from nerfbake import build_field, build_views, measure_views, orbit_cameras, render_field, sample_n3tree
    >>> field = build_field(sample_n3tree(resolution=8))
    >>> cameras = orbit_cameras(field, width=16, height=12)
    >>> pictures = [render_field(field, camera, background=None).pixels for camera in cameras.cameras]
    >>> min(error.psnr for error in measure_views(field, build_views(cameras, pictures))) > 45
    True
    """
    views.cameras.require_covered()
    shown_by, cameras = _renderer(scene, render), views.cameras.cameras

    def errors() -> Iterator[Callable[[], ViewError]]:
        for i, camera in progress.each(list(enumerate(cameras))):
            camera.require_memory(_PIXEL_BYTES)
            made = shown_by(camera, background=views.background, samples=samples).colour
            yield partial(_error, views, i, made)

    pixels = max((camera.width * camera.height for camera in cameras), default=1)
    return tuple(in_order(errors(), most=memory.left() // (2 * _PIXEL_BYTES * pixels)))


def _error(views: Views, i: int, shown: Singles) -> ViewError:
    """Measure a picture."""
    made, truth, used = shown.astype(np.float64), views.photograph(i).astype(np.float64), views.used(i)
    made[~used] = truth[~used]
    solid = used if views.scenery else used & ~views.behind(i)
    alike = np.where(solid[..., None], made * _gains(made[solid], truth[solid]), made)
    raw, corrected = (psnr(each[used], truth[used]) for each in (made, alike))
    return ViewError(views.cameras.cameras[i].name, raw, ssim(made, truth), corrected)


def _renderer(scene: Measured, render: Renderer) -> Callable[..., Image]:
    if isinstance(scene, Meshes):
        return partial(render_meshes, scene, lit=False)
    return partial(render_stage1, scene) if isinstance(scene, Stage1) else partial(render, scene)


def measure_silhouettes(scene: RadianceField | Meshes, views: Views) -> tuple[float, ...]:
    """Return for each view the intersection over union of the scene's silhouette and the photograph's, 0 to 1.

    The silhouettes have the pixels with an alpha of 1/2 or more; those of photographs without alpha, the pixels that
    differ from the background. It is 1 if both are empty. Raises InvalidScene for lenses that do not cover their
    pictures, MemoryLimit.

    >>> from nerfbake import Meshes, build_views, measure_silhouettes, orbit_cameras, render_meshes, sample_stage1
    >>> torus = Meshes(sample_stage1(resolution=16).meshes)
    >>> cameras = orbit_cameras(torus, width=16, height=12)
    >>> pictures = [render_meshes(torus, camera, background=None).pixels for camera in cameras.cameras]
    >>> measure_silhouettes(torus, build_views(cameras, pictures))
    (1.0,)
    """
    views.cameras.require_covered()
    render, found = _renderer(scene, KERNELS), []
    for i, camera in progress.each(list(enumerate(views.cameras.cameras))):
        made = render(camera).alpha >= 0.5
        truth = views.pictures[i][..., 3] >= 128 if views.masked else ~views.behind(i)
        either = int((made | truth).sum())
        found.append(int((made & truth).sum()) / either if either else 1.0)
    return tuple(found)


def _gains(made: Floats, truth: Floats) -> Floats:
    """Return the factors (3,) of colours (m, 3) that make them most similar to others by least squares."""
    square = np.square(made).sum(axis=0)
    return np.where(square > 0, (made * truth).sum(axis=0) / np.maximum(square, 1e-30), 1.0)
