"""How far a field's pictures are from the photographs."""

from __future__ import annotations

import numpy as np
import pytest

from nerfbake import Cameras, RadianceField, build_field, build_views, compare_scenes, measure_views, orbit_cameras
from nerfbake import render_field as render
from nerfbake.scene.image import Image
from tests.support.photographs import Pixels
from tests.support.scenes import n3tree


@pytest.fixture(scope="module")
def field() -> RadianceField:
    return build_field(n3tree(splits=[(0, (1, 0, 1))], data_format="SH4"))


@pytest.fixture(scope="module")
def cameras(field: RadianceField) -> Cameras:
    return orbit_cameras(field, frames=3, width=20, height=16)


def taken(field: RadianceField, cameras: Cameras) -> list[Pixels]:
    return [render(field, camera, background=None).pixels for camera in cameras.cameras]


def test_what_is_photographed_is_what_is_seen(field: RadianceField, cameras: Cameras) -> None:
    for background in ((1.0, 1.0, 1.0), (0.0, 0.2, 0.4)):
        errors = measure_views(field, build_views(cameras, taken(field, cameras), background=background))
        assert [error.name for error in errors] == [camera.name for camera in cameras.cameras]
        assert min(error.psnr for error in errors) > 50  # but for the rounding to 8 bits
        assert min(error.ssim for error in errors) > 0.999


def test_figures_are_those_of_compare_scenes(field: RadianceField, cameras: Cameras) -> None:
    darker = [np.concatenate([pixels[..., :3] // 2, pixels[..., 3:]], axis=2) for pixels in taken(field, cameras)]
    views = build_views(cameras, darker)
    whole = np.ones((16, 20), np.float32)
    truth = [Image(views.photograph(i), whole, 0 * whole) for i in range(3)]
    compared = compare_scenes(field, field, cameras, truth=truth)
    for error, view in zip(measure_views(field, views), compared.views, strict=True):
        assert (error.psnr, error.ssim) == (view["a_truth"]["psnr"], view["a_truth"]["ssim"])
