"""N x N rays a pixel, whatever is rendered: the picture of N times the size, averaged."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from nerfbake import (
    Camera,
    Image,
    Meshes,
    Stage1,
    build_field,
    memory_limit,
    orbit_cameras,
    render_field,
    render_field_and_meshes,
    render_meshes,
    render_stage1,
    sample_n3tree,
    sample_stage1,
)
from nerfbake.errors import InvalidScene, MemoryLimit
from nerfbake.scene.camera import look_at
from nerfbake.scene.lens import Lens
from nerfbake.stages import _supersampled
from nerfbake.stages._supersampled import supersampled
from tests.support.fields import front, solid
from tests.support.meshes import cube
from tests.support.scenes import n3tree

Render = Callable[..., Image]
FIELD = build_field(n3tree(splits=[(0, (1, 0, 1))], data_format="SH4", dtype=np.float32))
CUBE = Meshes((cube(0.3),))
VIEW = orbit_cameras(FIELD, width=13, height=7).cameras[0]
LENS = Lens("polynomial", (0.05, -0.01), (0.001, -0.002))


@cache  # a second, which collecting tests should not take
def sampled_stage1() -> Stage1:
    return sample_stage1(resolution=16)


def field(camera: Camera, **options: Any) -> Image:
    return render_field(FIELD, camera, **options)


def smooth(camera: Camera, **options: Any) -> Image:
    return render_field(FIELD, camera, lookup="trilinear", **options)


def mesh(camera: Camera, **options: Any) -> Image:
    return render_meshes(CUBE, camera, **options)


def stopped(camera: Camera, **options: Any) -> Image:
    return render_field_and_meshes(FIELD, CUBE, camera, **options)


def ztested(camera: Camera, **options: Any) -> Image:
    return render_field_and_meshes(FIELD, CUBE, camera, how="ztest", **options)


def stage1(camera: Camera, **options: Any) -> Image:
    scene = sampled_stage1()
    near = orbit_cameras(scene, width=camera.width, height=camera.height).cameras[0]
    return render_stage1(scene, near, **options)


KINDS = [field, smooth, mesh, stopped, ztested, stage1]


def boxes(image: Image, N: int) -> tuple[Any, Any, Any]:
    """Colour, alpha and depth of an image, averaged over N x N pixels; depth by alpha."""
    H, W = image.alpha.shape[0] // N, image.alpha.shape[1] // N
    colour = image.colour.reshape(H, N, W, N, 3).mean(axis=(1, 3), dtype=np.float64)
    alpha = image.alpha.reshape(H, N, W, N).mean(axis=(1, 3), dtype=np.float64)
    far = (image.alpha.astype(np.float64) * image.depth).reshape(H, N, W, N).mean(axis=(1, 3))
    return colour, alpha, np.divide(far, alpha, out=np.zeros_like(far), where=alpha > 0)


@pytest.mark.long
@pytest.mark.parametrize("N", [2, 3, 8])
@pytest.mark.parametrize("render", KINDS)
@pytest.mark.parametrize("background", [None, (0.2, 0.4, 0.6)])
def test_a_pixel_is_the_mean_of_a_finer_picture(render: Render, N: int, background: Any) -> None:
    found = render(VIEW, samples=N, background=background)
    finer = render(VIEW.resized(N * VIEW.width, N * VIEW.height), background=background)
    colour, alpha, depth = boxes(finer, N)
    assert alpha.max() > 0.5
    assert found.background == background
    assert_allclose(found.colour, colour, atol=1e-6)
    assert_allclose(found.alpha, alpha, atol=1e-6)
    assert_allclose(found.depth, depth, rtol=1e-5)


@pytest.mark.long
@pytest.mark.parametrize("render", KINDS)
def test_one_ray_a_pixel_changes_no_bit(render: Render) -> None:
    plain, one = render(VIEW), render(VIEW, samples=1)
    assert_array_equal(plain.colour, one.colour)
    assert_array_equal(plain.alpha, one.alpha)
    assert_array_equal(plain.depth, one.depth)


def test_rays_by_hand() -> None:
    # One pixel as wide as the focal length; the cube's front is 2.5 away and fills -1/5 to 1/5 of it.
    camera, opaque = Camera(1, 1, 1.0, look_at(np.full(3, 0.5), -np.pi / 2, 0, 3.0)), solid(1e6, red=30)
    one, two, three = (render_field(opaque, camera, background=None, samples=N) for N in (1, 2, 3))
    assert one.alpha[0, 0] == 1
    assert two.alpha[0, 0] == 0  # at -1/4 and 1/4 all four pass it
    assert three.alpha[0, 0] == np.float32(1 / 9)  # at -1/3, 0 and 1/3 the one in the middle does not
    assert_allclose(three.colour[0, 0], [1 / 9, 0.5 / 9, 0.5 / 9], rtol=1e-5)
    assert_allclose(three.depth[0, 0], 2.5, rtol=1e-5)  # of the ray that meets it, not a ninth of that


def test_parts_make_the_same_picture(monkeypatch: pytest.MonkeyPatch) -> None:
    cameras = [VIEW, Camera(13, 7, (9.0, 8.0), VIEW.pose, "bent", (6.0, 3.25), LENS)]
    whole = [render_field(FIELD, camera, samples=2) for camera in cameras]
    monkeypatch.setattr(_supersampled, "RAYS", 60)
    monkeypatch.setattr(_supersampled, "MAX_EDGE", 10)
    sizes = []

    def part(camera: Camera) -> Image:
        sizes.append((camera.width, camera.height))
        return render_field(FIELD, camera)

    for camera, expected in zip(cameras, whole, strict=True):
        found = supersampled(part, camera, 2)
        assert_allclose(found.colour, expected.colour, atol=1e-6)
        assert_allclose(found.alpha, expected.alpha, atol=1e-6)
        assert_allclose(found.depth, expected.depth, rtol=1e-5)
    assert len(sizes) == 2 * 3 * 3
    assert max(width for width, _ in sizes) <= 10
    assert max(width * height for width, height in sizes) <= 60


def test_memory_does_not_grow_with_the_rays() -> None:
    field, camera = build_field(sample_n3tree(resolution=8)), front(512)
    with memory_limit(70 << 20):
        render_field(field, camera, samples=1)
        render_field(field, camera, samples=4)  # at once, its rays would take 600 MiB
    with memory_limit(10 << 20), pytest.raises(MemoryLimit, match=r"a picture of \d+x\d+ pixels needs"):
        render_field(field, camera.resized(512, 512), samples=4)


@pytest.mark.parametrize("samples", [0, -1, 9, 2.5, float("nan"), float("inf"), 10**30, "2", None])
@pytest.mark.parametrize("render", KINDS)
def test_other_numbers_are_refused(render: Render, samples: Any) -> None:
    with pytest.raises(InvalidScene, match=r"samples are .*; allowed: 1 to 8"):
        render(VIEW, samples=samples)


def test_a_stop_is_one_rays() -> None:
    stop = np.full((7, 13), np.inf)
    with pytest.raises(InvalidScene, match="stop has one distance per pixel for 2 samples; allowed: 1 sample"):
        render_field(FIELD, VIEW, stop=stop, samples=2)
