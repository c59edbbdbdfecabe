"""How far a field's pictures are from the photographs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from nerfbake import (
    Cameras,
    Meshes,
    RadianceField,
    build_field,
    build_views,
    compare_scenes,
    measure_silhouettes,
    measure_views,
    orbit_cameras,
    render_meshes,
    render_stage1,
    sample_stage1,
)
from nerfbake import render_field as render
from nerfbake.scene.image import Image
from tests.support.meshes import camera, square, straight_down
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


def test_meshes_are_measured_with_and_without_highlights() -> None:
    stage1 = sample_stage1(resolution=32)
    plain = Meshes(tuple(mesh for mesh in stage1.meshes if mesh is not None))
    cameras = orbit_cameras(stage1, frames=2, width=40, height=30)
    pictures = [render_stage1(stage1, camera, background=None, samples=2).pixels for camera in cameras.cameras]
    views = build_views(cameras, pictures)
    whole, diffuse = (measure_views(scene, views, samples=2) for scene in (stage1, plain))
    assert min(error.psnr for error in whole) > 45
    assert max(error.psnr for error in diffuse) < 35


def test_vertex_colours_are_measured_as_radiance() -> None:
    painted = Meshes((replace(square(half=0.5), colours=np.full((4, 3), 0.4, np.float32)),))
    cameras = Cameras((camera(40, 40, elevation=0.3),))
    pictures = [render_meshes(painted, cameras.cameras[0], background=None, lit=False).pixels]
    assert measure_views(painted, build_views(cameras, pictures))[0].psnr > 50


def test_silhouettes_by_hand() -> None:
    # From 2 above, 4 x 4 pixels of half a unit: the square covers the middle four.
    cameras, shape = Cameras((straight_down(4, 4),)), Meshes((square(half=0.5),))
    picture = np.zeros((4, 4, 4), np.uint8)
    picture[1:3, 1:4, 3] = 255
    assert measure_silhouettes(shape, build_views(cameras, [picture])) == (4 / 6,)
    opaque = np.full((4, 4, 4), 255, np.uint8)
    opaque[2, 1:3, :3] = 0
    assert measure_silhouettes(shape, build_views(cameras, [opaque])) == (2 / 4,)
    picture[..., 3] = 0
    picture[0, 0, 3] = 127  # less than half is none, and one of two empty silhouettes is all that differs
    away = Meshes((square(z=5),))
    assert measure_silhouettes(away, build_views(cameras, [picture])) == (1.0,)


def test_figures_are_those_of_compare_scenes(field: RadianceField, cameras: Cameras) -> None:
    darker = [np.concatenate([pixels[..., :3] // 2, pixels[..., 3:]], axis=2) for pixels in taken(field, cameras)]
    views = build_views(cameras, darker)
    whole = np.ones((16, 20), np.float32)
    truth = [Image(views.photograph(i), whole, 0 * whole) for i in range(3)]
    compared = compare_scenes(field, field, cameras, truth=truth)
    for error, view in zip(measure_views(field, views), compared.views, strict=True):
        assert (error.psnr, error.ssim) == (view["a_truth"]["psnr"], view["a_truth"]["ssim"])
