"""What a graphics card shows of splats is what render_splats() shows; what it cannot do, the CPU does."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from nerfbake import (
    Camera,
    Splats,
    build_field,
    build_splats,
    measure_views,
    memory_limit,
    orbit_cameras,
    render_splats,
    sample_n3tree,
)
from nerfbake.device.gpu import Gpu
from nerfbake.errors import InvalidScene, MemoryLimit
from nerfbake.jobs.views import picture_views
from nerfbake.scene.camera import look_at
from nerfbake.scene.image import Image
from nerfbake.scene.lens import Lens
from nerfbake.stages import _splats_on_device
from nerfbake.stages.renderers import DeviceRenderer
from tests.support.device import opened
from tests.support.splats import splats

USUAL = 1e-4  # largest difference of colours and alpha, and of depths as a share of the largest
# Where the alpha of a splat is next to 1/255, one of the two may show it and the other not.
MOST, FEW = 1 / 255, 1e-3


@pytest.fixture(scope="module")
def gpu() -> Gpu:
    return opened()


@pytest.fixture
def told() -> list[str]:
    return []


@pytest.fixture
def render(gpu: Gpu, told: list[str]) -> DeviceRenderer:
    return DeviceRenderer(gpu, told.append)


@pytest.fixture(scope="module")
def many() -> Splats:
    """So many that tiles have several chunks of 256, and pixels close."""
    scene = splats(900, degree=1)
    return replace(scene, scales=scene.scales * 2, opacity=np.minimum(scene.opacity * 2, 1))


def seen(number: int = 0, **changes: Any) -> Camera:
    camera = Camera(41, 35, 30.0, look_at(np.zeros(3), 0.8 * number, 0.3, 6.0), str(number))
    return replace(camera, **changes)


def require_alike(found: Image, wanted: Image, usual: float = USUAL) -> None:
    assert found.background == wanted.background
    assert wanted.alpha.max() > 0.1
    there = wanted.alpha > 0.01
    furthest = wanted.depth.max()
    pairs = [(found.colour, wanted.colour), (found.alpha, wanted.alpha)]
    pairs.append((found.depth[there] / furthest, wanted.depth[there] / furthest))
    for one, other in pairs:
        differences = np.abs(one - other)
        assert differences.max() <= MOST
        assert (differences > usual).mean() <= FEW
    assert not found.depth[found.alpha == 0].any()


@pytest.mark.parametrize("degree", [0, 1, 2, 3, 4])
def test_every_degree_is_what_the_cpu_shows(render: DeviceRenderer, told: list[str], degree: int) -> None:
    scene = splats(60, degree=degree, antialiased=degree % 2 == 1)
    require_alike(render(scene, seen(degree)), render_splats(scene, seen(degree)))
    assert [line.split()[0] for line in told] == ["renders"]


@pytest.mark.parametrize("background", [None, (0.2, 0.3, 0.4)])
def test_crowded_tiles_are_what_the_cpu_shows(render: DeviceRenderer, many: Splats, background: Any) -> None:
    wanted = render_splats(many, seen(1), background=background)
    assert (wanted.alpha > 0.9998).any()  # closed pixels
    require_alike(render(many, seen(1), background=background), wanted)


def test_equal_depths_keep_their_order(render: DeviceRenderer) -> None:
    """The splats of a field are on a grid. From its diagonal, thousands of pairs have equal depths."""
    scene = build_splats(build_field(sample_n3tree(resolution=16)))
    scene = replace(scene, sh=np.random.default_rng(0).normal(size=scene.sh.shape).astype(np.float32))
    camera = replace(orbit_cameras(scene, width=48, height=48).cameras[0], pose=look_at(np.zeros(3), np.pi / 4, 0, 4.0))
    wanted = render_splats(scene, camera)
    require_alike(render(scene, camera), wanted)
    moved = scene.take(np.arange(scene.n)[::-1])
    assert np.abs(render_splats(moved, camera).colour - wanted.colour).max() > 0.05  # the order matters


@pytest.mark.parametrize("lens", [Lens("polynomial", (-0.1, 0.02), (0.001, 0.002)), Lens("fisheye", (0.05,))], ids=str)
def test_lenses_bend_pictures_as_on_the_cpu(render: DeviceRenderer, many: Splats, lens: Lens) -> None:
    camera = seen(lens=lens, centre=(20.0, 16.0))
    wanted = render_splats(many, camera)
    require_alike(render(many, camera), wanted)
    assert np.abs(wanted.colour - render_splats(many, seen(centre=(20.0, 16.0))).colour).max() > 0.01


def test_needles_and_discs_are_as_exact(render: DeviceRenderer) -> None:
    """In float32, the determinant of a needle's covariance has no digits but by the cross product of its axes."""
    scene = splats(60)
    scales = np.tile(np.array([[2.0, 1e-4, 1e-3], [1.0, 1.0, 1e-6], [3.0, 0.0, 0.0]], np.float32), (20, 1))
    for antialiased in (False, True):
        thin = replace(scene, scales=scales, antialiased=antialiased)
        require_alike(render(thin, seen(2)), render_splats(thin, seen(2)), usual=1e-3)


@pytest.mark.parametrize("times", [0.05, 20, 1e4])
def test_cameras_inside_and_far_away_are_as_exact(render: DeviceRenderer, many: Splats, times: float) -> None:
    pose = look_at(np.zeros(3), 0.8, 0.3, 6.0 * times)
    camera = seen(pose=pose, focal=30.0 * max(times, 1))
    wanted = render_splats(many, camera)
    require_alike(render(many, camera), wanted)


def test_a_camera_that_zooms_too_far_is_rendered_by_the_cpu(render: DeviceRenderer, many: Splats) -> None:
    camera = seen(focal=1e5)
    found, wanted = render(many, camera), render_splats(many, camera)
    assert found.colour.tobytes() == wanted.colour.tobytes()


def test_nothing_in_the_picture_is_the_background(render: DeviceRenderer) -> None:
    away = seen(pose=look_at(np.array([0.0, 0.0, 100.0]), 0.0, -1.5, 6.0))
    image = render(splats(5), away, background=(0.1, 0.2, 0.3))
    assert not image.alpha.any()
    assert not image.depth.any()
    np.testing.assert_array_equal(image.colour[3, 4], np.array([0.1, 0.2, 0.3], np.float32))


def test_two_runs_give_the_same_bytes(gpu: Gpu, many: Splats) -> None:
    one, other = (DeviceRenderer(gpu, lambda _: None)(many, seen()) for _ in range(2))
    for name in ("colour", "alpha", "depth"):
        assert getattr(one, name).tobytes() == getattr(other, name).tobytes()


def test_room_for_entries_grows_and_pictures_are_divided(
    gpu: Gpu, many: Splats, told: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    cameras = [seen(number) for number in range(3)]
    whole = list(DeviceRenderer(gpu, told.append).each(many, cameras))
    monkeypatch.setattr(_splats_on_device, "_ENTRIES", 0)
    monkeypatch.setattr(_splats_on_device, "_LEAST_ENTRIES", 10)
    grown = list(DeviceRenderer(gpu, told.append).each(many, cameras))
    monkeypatch.setattr(_splats_on_device.SplatsOnDevice, "_most", 2000)  # of about 5,000 entries
    divided = list(DeviceRenderer(gpu, told.append).each(many, cameras))
    for own, *others in zip(whole, grown, divided, strict=True):
        for other in others:
            assert other.colour.tobytes() == own.colour.tobytes()
            assert other.depth.tobytes() == own.depth.tobytes()
    assert [line.split()[0] for line in told] == ["renders"] * 3
    monkeypatch.setattr(_splats_on_device.SplatsOnDevice, "_most", 100)
    found = DeviceRenderer(gpu, told.append)(many, cameras[0])
    assert found.colour.tobytes() == render_splats(many, cameras[0]).colour.tobytes()
    assert told[-1].startswith("the splats of a row of tiles need room for ")
    assert told[-1].endswith("; the CPU renders instead")


def test_splats_above_the_limit_of_buffers_are_rendered_by_the_cpu(
    gpu: Gpu, told: list[str], many: Splats, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(gpu, "limits", gpu.limits._replace(binding=1 << 14))
    found = DeviceRenderer(gpu, told.append)(many, seen())
    assert found.colour.tobytes() == render_splats(many, seen()).colour.tobytes()
    (line,) = told
    assert line.startswith("the colours of 900 splats needs a buffer of ")


def test_after_the_device_is_lost_the_cpu_renders_the_rest(many: Splats, told: list[str]) -> None:
    gpu = opened()
    images = DeviceRenderer(gpu, told.append).each(many, [seen()] * 3)
    next(images)
    gpu.close()
    wanted = render_splats(many, seen())
    for image in images:
        require_alike(image, wanted)
    assert image.colour.tobytes() == wanted.colour.tobytes()
    assert "lost" in told[1]


def test_what_the_cpu_refuses_is_refused(render: DeviceRenderer) -> None:
    with pytest.raises(InvalidScene, match="samples"):
        render(splats(5), seen(), samples=9)
    with pytest.raises(InvalidScene, match="opacity"):
        render(replace(splats(1), opacity=np.array([2], np.float32)), seen())
    with memory_limit(1 << 20), pytest.raises(MemoryLimit):
        render(splats(5), seen(width=2000, height=2000))


def test_fits_are_judged_alike(render: DeviceRenderer, many: Splats) -> None:
    cameras = orbit_cameras(many, frames=2, width=32, height=32)
    views = picture_views(many, cameras, 1)
    other = many.take(np.arange(many.n) % 7 > 0)
    for one, own in zip(measure_views(other, views, render=render), measure_views(other, views), strict=True):
        assert abs(one.psnr - own.psnr) < 1e-3
