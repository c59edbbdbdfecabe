"""What a graphics card shows is what render_field() shows, in every channel; what it cannot do, the CPU does."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from nerfbake import (
    Camera,
    N3Tree,
    RadianceField,
    build_field,
    build_octree,
    memory_limit,
    orbit_cameras,
    render_field,
    sample_n3tree,
)
from nerfbake.device.gpu import Gpu
from nerfbake.errors import DeviceError, InvalidScene, MemoryLimit, NerfbakeError, UsageError
from nerfbake.scene.image import Image
from nerfbake.scene.lens import Lens
from nerfbake.stages import _field_on_device
from nerfbake.stages.renderers import KERNELS, DeviceRenderer
from tests.support.brick_fields import some_shelled_field
from tests.support.device import opened
from tests.support.scenes import n3tree, n3trees

COLOUR, DEPTH = 1e-4, 1e-5  # largest differences: of colours and alpha, and of depths as shares of the largest
LEFT = 1e-3  # alpha of pixels with a depth that is compared: the mean of nothing has no digits


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
def field() -> RadianceField:
    """SH9 in a box that is no cube."""
    return build_field(build_octree(sample_n3tree(resolution=16), resolution=(12, 16, 9)))


def seen(field: RadianceField, width: int = 43, height: int = 29) -> Camera:
    return orbit_cameras(field, frames=3, width=width, height=height).cameras[1]


def require_alike(found: Image, wanted: Image, colour: float = COLOUR, depth: float = DEPTH) -> None:
    assert found.background == wanted.background
    assert wanted.alpha.max() > 0.5
    np.testing.assert_allclose(found.colour, wanted.colour, atol=colour, rtol=0)
    np.testing.assert_allclose(found.alpha, wanted.alpha, atol=colour, rtol=0)
    there = wanted.alpha > LEFT
    np.testing.assert_allclose(found.depth[there], wanted.depth[there], atol=depth * wanted.depth.max(), rtol=0)
    assert not found.depth[found.alpha == 0].any()


@pytest.mark.parametrize("basis", ["SH1", "SH4", "SH9", "SH16", "SH25"])
def test_every_basis_is_what_the_cpu_shows(render: DeviceRenderer, told: list[str], basis: str) -> None:
    field = build_field(sample_n3tree(resolution=8, basis=basis))
    require_alike(render(field, seen(field)), render_field(field, seen(field)))
    assert [line.split()[0] for line in told] == ["renders"]


@pytest.mark.slow
@settings(max_examples=12)
@given(n3trees(), st.sampled_from(["nearest", "trilinear"]), st.integers(0, 2))
def test_random_trees_are_what_the_cpu_shows(gpu: Gpu, tree: N3Tree, lookup: Any, number: int) -> None:
    try:
        field = build_field(tree)
    except NerfbakeError:
        assume(False)
    camera = orbit_cameras(field, frames=3, width=9, height=7).cameras[number]
    found, wanted = (each(field, camera, lookup=lookup) for each in (DeviceRenderer(gpu, lambda _: None), KERNELS))
    for name in ("colour", "alpha"):
        np.testing.assert_allclose(getattr(found, name), getattr(wanted, name), atol=COLOUR, rtol=0)


def test_a_field_without_leaves_is_clear(render: DeviceRenderer) -> None:
    tree = n3tree(data=np.zeros((1, 2, 2, 2, 4), np.float16))
    field = build_field(tree)
    assert not len(field.values)
    image = render(field, seen(field), background=(0.1, 0.2, 0.3))
    assert not image.alpha.any()
    np.testing.assert_array_equal(image.colour[0, 0], np.array([0.1, 0.2, 0.3], np.float32))


def test_a_field_without_harmonics_is_what_the_cpu_shows(render: DeviceRenderer, field: RadianceField) -> None:
    octree = build_octree(sample_n3tree(resolution=8), resolution=8)
    density = octree.node_data[:, -1:].copy()
    grey = build_field(replace(octree, node_data=density, data_format=""))
    assert grey.basis.kind == "RGBA"
    require_alike(render(grey, seen(grey)), render_field(grey, seen(grey)))


@pytest.mark.parametrize(
    "options",
    [
        {"background": None},
        {"background": (0.2, 0.3, 0.4)},
        {"samples": 2},
        {"samples": 3, "background": None},
        {"transmittance_cut": 0.5},
        {"transmittance_cut": 0},
        {"lookup": "trilinear"},
        {"lookup": "trilinear", "samples": 2, "background": None},
    ],
    ids=str,
)
def test_every_option_is_what_the_cpu_does(
    render: DeviceRenderer, field: RadianceField, options: dict[str, Any]
) -> None:
    require_alike(render(field, seen(field), **options), render_field(field, seen(field), **options))


@pytest.mark.parametrize("lookup", ["nearest", "trilinear"])
def test_rays_stop_where_they_are_told(render: DeviceRenderer, field: RadianceField, lookup: Any) -> None:
    camera = seen(field)
    free = render_field(field, camera, lookup=lookup)
    stop = np.random.default_rng(0).uniform(0.9, 1.1, free.depth.shape) * np.where(free.alpha > 0.5, free.depth, 1.0)
    stop[::2] = np.inf
    wanted = render_field(field, camera, stop=stop, lookup=lookup)
    require_alike(render(field, camera, stop=stop, lookup=lookup), wanted)
    assert np.abs(wanted.colour - free.colour).max() > 0.1


@pytest.mark.parametrize("lookup", ["nearest", "trilinear"])
@pytest.mark.parametrize("times", [0.0, 0.5, 10, 1e3, 1e5])
def test_cameras_inside_and_far_away_are_as_exact(
    render: DeviceRenderer, field: RadianceField, times: float, lookup: Any
) -> None:
    camera = seen(field)
    (middle,) = field.world(field.box.mean(axis=0)[None])
    pose = camera.pose.copy()
    pose[:3, 3] = middle + times * (pose[:3, 3] - middle)
    moved = replace(camera, pose=pose, focal=camera.fx * max(times, 1))
    require_alike(render(field, moved, lookup=lookup), render_field(field, moved, lookup=lookup))


def test_rays_along_an_axis_are_as_exact(render: DeviceRenderer, field: RadianceField) -> None:
    (middle,) = field.world(field.box.mean(axis=0)[None])
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = [[-1, 0, 0], [0, 0, 1], [0, 1, 0]], middle + np.array([0, 9, 0])
    camera = Camera(33, 33, 60.0, pose, "along")  # its middle pixel looks along y
    require_alike(render(field, camera), render_field(field, camera))


@pytest.mark.parametrize("samples", [1, 2])
@pytest.mark.parametrize("lens", [Lens("polynomial", (-0.1, 0.02), (0.001, 0.002)), Lens("fisheye", (0.05,))], ids=str)
def test_lenses_bend_rays_as_on_the_cpu(render: DeviceRenderer, field: RadianceField, lens: Lens, samples: int) -> None:
    camera = replace(seen(field), lens=lens, centre=(20.0, 16.0))
    wanted = render_field(field, camera, samples=samples)
    require_alike(render(field, camera, samples=samples), wanted)
    assert np.abs(wanted.colour - render_field(field, replace(camera, lens=None), samples=samples).colour).max() > 0.01


@pytest.mark.parametrize(("lookup", "colour"), [("nearest", COLOUR), ("trilinear", 2e-3)])
def test_scenery_is_what_the_cpu_shows(render: DeviceRenderer, lookup: Any, colour: float) -> None:
    """From inside the inner cube, which is 2^-7 of the edge of the tree. Interpolated, a ray crosses 2,000 cells."""
    field = build_field(some_shelled_field(shells=8))
    (middle,) = field.world(field.box.mean(axis=0)[None])
    for turn in ([0, 1, 2], [2, 0, 1]):
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = np.eye(3)[turn], middle + np.array([0.013, -0.021, 0.04])
        camera = Camera(40, 30, 30.0, pose, "inside")
        found, wanted = render(field, camera, lookup=lookup), render_field(field, camera, lookup=lookup)
        require_alike(found, wanted, colour, depth=colour)


def test_a_picture_of_many_parts_is_one(
    render: DeviceRenderer, field: RadianceField, monkeypatch: pytest.MonkeyPatch
) -> None:
    camera = seen(field)
    whole = render(field, camera, samples=2)
    monkeypatch.setattr(_field_on_device, "_RAYS", 4 * 43 * 7)
    parts = render(field, camera, samples=2)
    np.testing.assert_allclose(parts.colour, whole.colour, atol=1e-6)
    np.testing.assert_allclose(parts.depth, whole.depth, atol=1e-4)
    stop = np.full((29, 43), np.inf)
    stop[10:] = 1e-3
    assert render(field, camera, stop=stop).alpha[:10].max() > 0.5
    assert not render(field, camera, stop=stop).alpha[10:].any()


def test_two_runs_give_the_same_bytes(gpu: Gpu, field: RadianceField) -> None:
    for lookup in ("nearest", "trilinear"):
        one, other = (
            DeviceRenderer(gpu, lambda _: None)(field, seen(field), samples=2, lookup=lookup) for _ in range(2)
        )
        for name in ("colour", "alpha", "depth"):
            assert getattr(one, name).tobytes() == getattr(other, name).tobytes()


def test_pictures_of_several_cameras_come_in_their_order(render: DeviceRenderer, field: RadianceField) -> None:
    cameras = [replace(seen(field), width=width) for width in (20, 43, 20, 31)]
    for renderer in (render, KERNELS):
        found = list(renderer.each(field, cameras, samples=2))
        assert [image.size[0] for image in found] == [20, 43, 20, 31]
        for image, camera in zip(found, cameras, strict=True):
            require_alike(image, render_field(field, camera, samples=2))


def test_wrong_options_are_refused_as_on_the_cpu(render: DeviceRenderer, field: RadianceField) -> None:
    camera = seen(field)
    for wrong in ({"samples": 9}, {"transmittance_cut": 1}, {"lookup": "cubic"}, {"stop": np.zeros((1, 1))}):
        with pytest.raises(InvalidScene) as raised:
            render_field(field, camera, **wrong)
        with pytest.raises(InvalidScene) as again:
            render(field, camera, **wrong)
        assert str(again.value) == str(raised.value)
    with pytest.raises(UsageError, match="is not a RadianceField"):
        render(sample_n3tree(resolution=8), camera)  # type: ignore[arg-type]


def test_a_picture_above_the_memory_limit_is_refused(render: DeviceRenderer, field: RadianceField) -> None:
    with memory_limit(1 << 20), pytest.raises(MemoryLimit):
        render(field, replace(seen(field), width=2000, height=2000))


def test_a_field_above_the_limit_of_buffers_is_rendered_by_the_cpu(
    gpu: Gpu, told: list[str], field: RadianceField, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(gpu, "limits", gpu.limits._replace(binding=1 << 14))
    found = DeviceRenderer(gpu, told.append)(field, seen(field))
    assert found.colour.tobytes() == render_field(field, seen(field)).colour.tobytes()
    (line,) = told
    assert "; allowed: 16.0 KiB on " in line
    assert line.endswith("; the CPU renders instead")


def test_trees_of_three_cells_along_an_edge_are_rendered_by_the_cpu(render: DeviceRenderer, told: list[str]) -> None:
    field = build_field(n3tree(splits=[(0, (0, 1, 2)), (1, (2, 2, 2))], N=3))
    assert field.cells.radix == 3
    for _ in range(2):
        assert render(field, seen(field)).colour.tobytes() == render_field(field, seen(field)).colour.tobytes()
    assert len(told) == 1


def test_a_bent_camera_far_away_is_rendered_by_the_cpu(render: DeviceRenderer, field: RadianceField) -> None:
    camera = seen(field)
    (middle,) = field.world(field.box.mean(axis=0)[None])
    pose = camera.pose.copy()
    pose[:3, 3] = middle + 1e4 * (pose[:3, 3] - middle)
    far = replace(camera, pose=pose, focal=1e4 * camera.fx, lens=Lens("polynomial", (-0.1,)))
    assert render(field, far).colour.tobytes() == render_field(field, far).colour.tobytes()


def test_after_the_device_is_lost_the_cpu_renders_the_rest(field: RadianceField, told: list[str]) -> None:
    gpu = opened()
    render = DeviceRenderer(gpu, told.append)
    cameras = [seen(field)] * 4
    images = render.each(field, cameras)
    next(images)
    gpu.close()
    wanted = render_field(field, cameras[0])
    for image in images:
        require_alike(image, wanted)
    assert image.colour.tobytes() == wanted.colour.tobytes()
    named, lost = told
    assert named.startswith("renders on ")
    assert "lost" in lost
    assert "\n" not in lost


def test_an_error_while_waiting_is_rendered_by_the_cpu(
    gpu: Gpu, field: RadianceField, told: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise DeviceError("the driver has not finished")

    monkeypatch.setattr(Gpu, "wait_for", fail)
    found = DeviceRenderer(gpu, told.append)(field, seen(field))
    assert found.colour.tobytes() == render_field(field, seen(field)).colour.tobytes()
    assert told[1:] == ["the driver has not finished; the CPU renders instead"]
