"""Cameras and their pictures: sizes, backgrounds, masks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from nerfbake import Camera, Cameras, build_views
from nerfbake.errors import InvalidScene
from nerfbake.kernels.picture.reduction import reduced_picture
from nerfbake.stages.pictures_to_views import apply_mask
from tests.support.photographs import Pixels, over, spot

CAMERA = Camera(12, 9, (10.0, 11.0), np.eye(4), "a", centre=(5.0, 4.0), picture="images/a.png")


def cameras(count: int = 1) -> Cameras:
    return Cameras(tuple(replace(CAMERA, name=f"r_{i}") for i in range(count)))


def opaque(pixels: Pixels) -> Pixels:
    return np.concatenate([pixels[..., :3], np.full_like(pixels[..., :1], 255)], axis=2)


def test_a_larger_print_of_the_same_view_resizes_its_camera() -> None:
    views = build_views(cameras(), [spot(24, 18)])
    (camera,) = views.cameras.cameras
    assert (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy) == (24, 18, 20.0, 22.0, 10.0, 8.0)


@pytest.mark.parametrize(("edge", "size"), [(18, (24, 18)), (17, (12, 9)), (8, (8, 6)), (5, (6, 4)), (1, (1, 1))])
def test_large_pictures_are_reduced_by_a_whole_factor(edge: int, size: tuple[int, int]) -> None:
    picture = spot(24, 18)
    views = build_views(cameras(), [picture], edge=edge)
    (camera,), factor = views.cameras.cameras, 18 // size[1]
    assert (camera.width, camera.height) == size
    assert camera.cx == pytest.approx(10.0 / factor)  # of the 24 columns, also if some are cut off
    assert_array_equal(views.pictures[0], reduced_picture(picture, factor))


@pytest.mark.parametrize(("width", "height"), [(5, 4), (4, 3), (3, 2), (24, 18), (25, 19), (23, 17)])
def test_edges_of_a_print_are_rounded(width: int, height: int) -> None:
    assert build_views(cameras(), [spot(width, height)]).pictures[0].shape == (height, width, 4)


def test_a_picture_of_another_shape_is_refused() -> None:
    said = r"picture images/a\.png has 24x24 pixels; allowed: the shape of its camera's 12x9"
    with pytest.raises(InvalidScene, match=said):
        build_views(cameras(), [spot(24, 24)])


def test_alpha_tells_the_object_and_lies_over_white_unless_told() -> None:
    views = build_views(cameras(2), [spot(12, 9), spot(12, 9)])
    assert (views.background, views.masked) == ((1.0, 1.0, 1.0), True)
    assert_array_equal(views.behind(0), spot(12, 9)[..., 3] == 0)
    assert build_views(cameras(), [spot(12, 9)], background=(0.0, 0.5, 1.0)).background == (0.0, 0.5, 1.0)


def test_a_plain_background_is_found_at_the_edges() -> None:
    pictures = [opaque(over(spot(12, 9, i), (250, 10 + 2 * i, 0))) for i in range(3)]
    views = build_views(cameras(3), pictures)
    assert (views.background, views.masked) == ((250 / 255, 12 / 255, 0.0), False)
    for i in range(3):
        assert_array_equal(views.behind(i), spot(12, 9)[..., 3] == 0)
    assert build_views(cameras(3), pictures, background=(1.0, 0.0, 0.0)).background == (1.0, 0.0, 0.0)


def test_an_object_that_is_cut_off_leaves_the_background_plain() -> None:
    pixels = opaque(over(spot(12, 9), (255, 255, 255)))
    pixels[-2:, 1:] = 0
    assert build_views(cameras(), [pixels]).background == (1.0, 1.0, 1.0)


def test_scenery_behind_the_object_is_one_line_that_tells_of_masks() -> None:
    pixels = np.random.default_rng(0).integers(0, 256, (9, 12, 4), np.uint8)
    pixels[..., 3] = 255
    with pytest.raises(InvalidScene, match=r"show scenery behind the object: only \d+ % .* or `scenery=keep`"):
        build_views(cameras(), [pixels], scenery="drop")
    with pytest.raises(InvalidScene, match=r"only 0 % of their edges are near 255,0,255; allowed"):
        build_views(cameras(), [opaque(over(spot(12, 9), (255, 255, 255)))], background=(1.0, 0.0, 1.0))


def test_scenery_is_kept_where_the_pictures_show_it() -> None:
    pixels = np.random.default_rng(0).integers(0, 256, (9, 12, 4), np.uint8)
    pixels[..., 3] = 255
    kept = build_views(cameras(), [pixels])
    assert kept.scenery
    assert str(kept) == "1 picture with scenery"
    np.testing.assert_allclose(kept.background, pixels[..., :3].mean(axis=(0, 1)) / 255)
    plain = opaque(over(spot(12, 9), (255, 255, 255)))
    assert not build_views(cameras(), [plain]).scenery
    assert build_views(cameras(), [plain], scenery="keep").scenery
    assert not build_views(cameras(), [spot(12, 9)]).scenery
    with pytest.raises(InvalidScene, match="has no pixel with alpha 255; allowed: a mask that is white"):
        build_views(cameras(), [pixels // 2], scenery="keep")
    used = build_views(cameras(), [spot(12, 9)], scenery="keep")
    np.testing.assert_array_equal(used.used(0), spot(12, 9)[..., 3] == 255)


@pytest.mark.parametrize("pixels", [np.zeros((9, 12, 4), np.uint8), np.full((9, 12, 4), 255, np.uint8)])
def test_pictures_of_nothing_are_refused(pixels: Pixels) -> None:
    with pytest.raises(InvalidScene, match="the pictures show nothing but the background"):
        build_views(cameras(2), [pixels, pixels])
    build_views(cameras(2), [pixels, spot(12, 9) if pixels[0, 0, 3] == 0 else opaque(over(spot(12, 9), (255,) * 3))])


def test_a_picture_too_few_is_told() -> None:
    with pytest.raises(InvalidScene, match="pictures are 1; allowed: 2, one a camera"):
        build_views(cameras(2), [spot(12, 9)])


def test_a_mask_is_its_alpha_or_its_brightness() -> None:
    scenery = np.random.default_rng(0).integers(0, 256, (9, 12, 4), np.uint8)
    grey = np.full((9, 12, 4), 255, np.uint8)
    grey[..., :3] = spot(12, 9)[..., 3:]
    for mask in (spot(12, 9), grey):
        made = apply_mask(scenery, mask)
        assert_array_equal(made[..., :3], scenery[..., :3])
        assert_array_equal(made[..., 3], spot(12, 9)[..., 3])
    with pytest.raises(InvalidScene, match="the mask has 9x9 pixels; allowed: 12x9, as its picture"):
        apply_mask(scenery, spot(9, 9))


@pytest.mark.parametrize("brightest", [1, 127])
def test_a_mask_of_labels_is_refused(brightest: int) -> None:
    """Segmentation writes 0 and 1, which as alpha would make the object as good as invisible."""
    picture, mask = opaque(over(spot(12, 9), (255,) * 3)), np.zeros((9, 12, 4), np.uint8)
    mask[..., 3] = 255
    assert not apply_mask(picture, mask)[..., 3].any()  # the object may be outside of the picture
    mask[3, 4, :3] = brightest
    with pytest.raises(InvalidScene, match=rf"the mask is {brightest} at its brightest; allowed: 255 \(white\) where"):
        apply_mask(picture, mask)


def test_photographs_are_over_their_background() -> None:
    pixels = np.zeros((9, 12, 4), np.uint8)
    pixels[4, 4] = (255, 0, 51, 102)
    views = build_views(cameras(), [pixels], background=(0.0, 1.0, 0.5))
    assert_array_equal(views.photograph(0)[0, 0], np.array([0, 1, 0.5], np.float32))
    np.testing.assert_allclose(views.photograph(0)[4, 4], [0.4, 0.6, 0.2 * 0.4 + 0.6 * 0.5], atol=1e-6)
