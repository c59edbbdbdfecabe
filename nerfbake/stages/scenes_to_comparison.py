"""Two scenes and cameras -> a comparison of the scenes' pictures and values."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from nerfbake import progress
from nerfbake.errors import InvalidScene, Problem
from nerfbake.kernels.picture.metrics import psnr, ssim
from nerfbake.scene.camera import Cameras
from nerfbake.scene.comparison import Comparison
from nerfbake.scene.image import WHITE, Image
from nerfbake.scene.radiance_field import RadianceField
from nerfbake.stages.picture import Visible, render_picture, renderable
from nerfbake.stages.renderers import KERNELS, Renderer
from nerfbake.stages.scene_to_field import FieldSource

MAX_POINTS = 200_000  # most leaves whose values are compared
_PIXEL_BYTES = 280  # per pixel while two pictures are compared (238 measured, plus the pictures themselves)


def compare_scenes(
    a: Visible | FieldSource,
    b: Visible | FieldSource,
    cameras: Cameras,
    *,
    truth: Sequence[Image] | None = None,
    keep_pictures: bool = True,
    pictures_of_a: Sequence[Image] | None = None,
    render: Renderer = KERNELS,
) -> Comparison:
    """Render both scenes with every camera, over white, and measure the differences.

    truth: a photograph for each camera. keep_pictures: False keeps only one view's pictures in memory at a time; the
    comparison then has no pictures to draw. pictures_of_a: those of render_picture() with these cameras and their
    samples, if a is compared with several scenes; None: they are rendered. render: renders fields and
    splats.

    The number of rays per pixel is that of the cameras. Fields are built for scenes of other types; pass a field that
    you have already built to save this time. Errors are on sRGB in 0..1, before rounding to 8 bits. Raises InvalidScene
    for scenes that cannot be rendered, for photographs that differ from the cameras in number or size, and for lenses
    that do not cover their pictures.

    >>> from nerfbake import build_field, build_octree, compare_scenes, orbit_cameras, sample_n3tree
    >>> tree = sample_n3tree(resolution=8)
    >>> field = build_field(tree)
    >>> found = compare_scenes(field, build_octree(tree), orbit_cameras(field, width=16, height=12))
    >>> found.means["a_b"]["psnr"] > 40
    True
    """
    if truth is not None and len(truth) != len(cameras.cameras):
        raise InvalidScene(Problem("truth", f"has {len(truth)} pictures", f"{len(cameras.cameras)}, one a camera"))
    if pictures_of_a is not None and len(pictures_of_a) != len(cameras.cameras):
        found = f"are {len(pictures_of_a)}"
        raise InvalidScene(Problem("the pictures of a", found, f"{len(cameras.cameras)}, one a camera"))
    cameras.require_covered()
    one, other = renderable(a), renderable(b)
    views, pictures, samples = [], [], cameras.samples
    for i, camera in progress.each(list(enumerate(cameras.cameras))):
        camera.require_memory(_PIXEL_BYTES)
        known = {} if pictures_of_a is None else {"a": pictures_of_a[i]}
        both = progress.each([(name, scene) for name, scene in (("a", one), ("b", other)) if name not in known])
        seen = known | {name: render_picture(scene, camera, samples=samples, render=render) for name, scene in both}
        view: dict[str, Any] = {"name": camera.name, "a_b": _errors(seen["a"], seen["b"])}
        photograph = None
        if truth is not None:
            photograph = truth[i].over(WHITE)
            if photograph.alpha.shape != (camera.height, camera.width):
                height, width = photograph.alpha.shape
                found = f"has {width}x{height} pixels"
                raise InvalidScene(Problem(f"truth of {camera.name}", found, f"{camera.width}x{camera.height}"))
            view |= {f"{name}_truth": _errors(image, photograph) for name, image in seen.items()}
        views.append(view)
        if keep_pictures:
            pictures.append((photograph, seen["a"], seen["b"]))
    return Comparison(tuple(views), _value_errors(one, other), tuple(pictures), samples)


def _errors(a: Image, b: Image) -> dict[str, float]:
    x, y = a.colour.astype(np.float64), b.colour.astype(np.float64)
    return {"psnr": psnr(x, y), "ssim": ssim(x, y), "max_error": float(np.abs(x - y).max())}


def _value_errors(a: Visible, b: Visible) -> dict[str, Any]:
    if not (isinstance(a, RadianceField) and isinstance(b, RadianceField)) or a.basis != b.basis:
        return {}
    points = a.leaf_centres(MAX_POINTS)
    difference = np.abs(a.sample(points) - b.sample(points))
    colours = difference[:, :-1].reshape(len(points), 3, a.basis.size)
    parts = {"sigma": difference[:, -1], "dc": colours[..., 0], "higher": colours[..., 1:]}
    return {name: _mean_and_max(part) for name, part in parts.items() if part.size}


def _mean_and_max(values: npt.NDArray[np.float32]) -> dict[str, float]:
    return {"mean": float(values.mean(dtype=np.float64)), "max": float(values.max())}
