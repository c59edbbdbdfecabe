"""Photographs of a field with scenery around it, cut out by the field's opacity."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from nerfbake import Camera, Cameras, Views, build_field, build_views, cut_out_field, render_field, sample_n3tree
from nerfbake.errors import InvalidScene
from nerfbake.scene.camera import look_at
from nerfbake.scene.radiance_field import RadianceField


@pytest.fixture(scope="module")
def field() -> RadianceField:
    return build_field(sample_n3tree(resolution=16))


def photographs(field: RadianceField) -> Views:
    """Two photographs of the field before noise, and one of noise alone, with cameras that look at and past it."""
    middle = field.world(field.box.mean(axis=0))
    poses = [look_at(middle, azimuth, 0.3, 4.0) for azimuth in (0.0, 1.0, 2.0)]
    poses[2][:3, 2] *= -1
    cameras = Cameras(tuple(Camera(32, 24, 30.0, pose, str(i)) for i, pose in enumerate(poses)))
    random, pictures = np.random.default_rng(0), []
    for camera in cameras.cameras:
        image, noise = render_field(field, camera, background=None), random.random((24, 32, 3))
        pixels = np.full((24, 32, 4), 255, np.uint8)
        pixels[..., :3] = np.rint(255 * (image.colour + (1 - image.alpha[..., None]) * noise))
        pictures.append(pixels)
    return build_views(cameras, pictures, scenery="keep")


def test_photographs_keep_their_colours_and_get_the_opacity_of_the_field(field: RadianceField) -> None:
    views = photographs(field)
    alone = cut_out_field(views, field)
    assert (alone.masked, alone.scenery, alone.rough, alone.background) == (True, False, True, (1.0, 1.0, 1.0))
    assert [camera.name for camera in alone.cameras.cameras] == ["0", "1"]  # the third shows noise alone
    for number, camera in enumerate(alone.cameras.cameras):
        assert_array_equal(alone.pictures[number][..., :3], views.pictures[number][..., :3])
        seen = render_field(field, camera).alpha
        assert_array_equal(alone.pictures[number][..., 3], np.rint(255 * seen).astype(np.uint8))
    assert (views.pictures[0][..., 3] == 255).all()  # the given pictures are unchanged


def test_ignored_pixels_are_transparent(field: RadianceField) -> None:
    views = photographs(field)
    pictures = [each.copy() for each in views.pictures]
    pictures[0][:, :16, 3] = 0
    alone = cut_out_field(replace(views, pictures=tuple(pictures), masked=True), field)
    assert (alone.pictures[0][:, :16, 3] == 0).all()
    assert_array_equal(alone.pictures[0][:, 16:], cut_out_field(views, field).pictures[0][:, 16:])


def test_photographs_without_the_field_are_refused(field: RadianceField) -> None:
    with pytest.raises(InvalidScene, match="the field is in none of the photographs; allowed: a part of what they"):
        cut_out_field(photographs(field).take([2]), field)
