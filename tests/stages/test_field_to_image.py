from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from nerfbake import (
    Camera,
    RadianceField,
    build_field,
    build_octree,
    orbit_cameras,
    render_field,
)
from nerfbake.errors import InvalidScene, UsageError
from nerfbake.kernels.march.cells import EMPTY, cells_of
from nerfbake.kernels.march.sh import sh_basis
from nerfbake.scene.basis import Basis
from nerfbake.scene.camera import look_at
from nerfbake.scene.radiance_field import leaf_box
from tests.support.fields import front, solid
from tests.support.scenes import n3tree


@pytest.mark.parametrize("sigma", [0.1, 1.0, 30.0])
def test_a_homogeneous_box_lets_through_what_the_law_says(sigma: float) -> None:
    image = render_field(solid(sigma, red=2), front(), transmittance_cut=0)
    middle = image.alpha[2, 2], image.colour[2, 2], image.depth[2, 2]
    alpha = 1 - np.exp(-sigma)
    assert_allclose(middle[0], alpha, rtol=1e-4)
    assert_allclose(middle[1][0], 1 / (1 + np.exp(-2)) * alpha + 1 - alpha, rtol=1e-4)
    # E[d] of an exponential cut off after the box's width, which starts 2.5 away.
    mean = (1 / sigma) - np.exp(-sigma) / alpha
    assert_allclose(middle[2], 2.5 + mean, rtol=1e-4)


def test_a_ray_through_very_many_leaves_keeps_all_of_their_colours() -> None:
    # A column of thin leaves along y: twice as many as a ray remembers before it adds their colours up.
    n, sigma = 128, np.float32(0.02)
    slots = np.full((n, n, n), EMPTY, np.int32)
    slots[0, :, 0] = -2 - np.arange(n)
    values = np.zeros((n, 4), np.float32)
    values[:, 0], values[:, 3] = np.random.default_rng(0).normal(0, 2, n), sigma
    field = RadianceField(cells_of(slots, [7]), values, np.eye(3, 4), leaf_box(cells_of(slots, [7])), Basis("RGBA", 1))
    camera = Camera(1, 1, 1.0, look_at(np.array([0.5, 0, 0.5]), -np.pi / 2, 0, 9.0))
    image = render_field(field, camera, background=None, transmittance_cut=0)
    weights = np.exp(-sigma * np.arange(n)) * (1 - np.exp(-sigma))
    assert_allclose(image.alpha[0, 0], weights.sum(), rtol=1e-5)
    assert_allclose(image.colour[0, 0, 0], (weights / (1 + np.exp(-values[:, 0]))).sum(), rtol=1e-5)
    assert_allclose(image.colour[0, 0, 1:], weights.sum() / 2, rtol=1e-5)


def test_densities_are_per_world_unit_whatever_the_box() -> None:
    # The same box, twice as wide, half as dense: the tree's scale must not show.
    a = render_field(solid(3.0), front())
    b = render_field(solid(1.5, invradius=np.full(3, 0.5)), Camera(5, 5, 20.0, look_at(np.ones(3), -np.pi / 2, 0, 6.0)))
    assert_allclose(a.alpha, b.alpha, atol=1e-4)
    assert_allclose(2 * a.depth, b.depth, atol=1e-3)


def test_an_opaque_plane_stands_where_it_stands() -> None:
    data = np.zeros((1, 2, 2, 2, 4), np.float32)
    data[0, :, 1, :, 3] = 1e6  # the half y > 0.5
    image = render_field(build_field(n3tree(data=data, data_format="RGBA")), front())
    assert_allclose(image.depth[2, 2], 3.0, atol=1e-4)
    assert_allclose(image.alpha[2, 2], 1)


def test_colours_are_spherical_harmonics_in_the_rays_direction() -> None:
    data = np.zeros((1, 2, 2, 2, 28), np.float32)
    coefficients = np.random.default_rng(0).normal(0, 1, (3, 9))
    data[..., :27], data[..., 27] = coefficients.ravel(), 1e6
    camera = Camera(9, 7, 60.0, look_at(np.full(3, 0.5), 0.3, 0.4, 3))
    image = render_field(build_field(n3tree(data=data, data_format="SH9")), camera)
    _, directions = camera.rays()
    expected = 1 / (1 + np.exp(-sh_basis(directions, 9) @ coefficients.T))
    assert_allclose(image.colour.reshape(-1, 3), expected, atol=1e-5)


def test_backgrounds() -> None:
    field = solid(1.0, red=1)
    clear = render_field(field, front(), background=None)
    for colour in ((1.0, 1.0, 1.0), (0.0, 0.0, 0.0), (0.2, 0.4, 0.6)):
        over = render_field(field, front(), background=colour)
        assert_allclose(over.colour, clear.colour + (1 - clear.alpha[..., None]) * np.array(colour), atol=1e-6)
    assert clear.pixels.shape == (5, 5, 4)
    assert over.pixels.shape == (5, 5, 3)
    # Straight alpha: the colour is the leaf's own.
    assert abs(int(clear.pixels[2, 2, 0]) - 255 / (1 + np.exp(-1))) < 1


def test_a_cut_makes_an_opaque_cutout() -> None:
    faint, dense = (render_field(solid(sigma), front(), transmittance_cut=0.5).alpha[2, 2] for sigma in (0.2, 5.0))
    assert faint < 0.5 < dense


def test_a_camera_inside_sees_only_what_is_ahead() -> None:
    camera = Camera(3, 3, 30.0, look_at(np.full(3, 0.5), -np.pi / 2, 0, 1e-9))
    assert_allclose(render_field(solid(1.0), camera, transmittance_cut=0).alpha[1, 1], 1 - np.exp(-0.5), rtol=1e-3)
    away = Camera(3, 3, 30.0, look_at(np.array([0.5, 3.0, 0.5]), -np.pi / 2, 0, 1.0))
    assert_array_equal(render_field(solid(1.0), away).alpha, 0)


@pytest.mark.parametrize("N", [2, 3])
def test_an_octree_looks_like_the_tree_it_was_made_from(N: int) -> None:
    tree = n3tree(splits=[(0, (1, 0, 1)), (1, (1, 1, 1))], N=N, data_format="SH4", dtype=np.float32)
    one, other = build_field(tree), build_field(build_octree(tree, resample="nearest"))
    camera = orbit_cameras(one, width=24, height=20).cameras[0]
    a, b = render_field(one, camera), render_field(other, camera)
    assert a.alpha.max() > 0.1
    assert_allclose(a.colour, b.colour, atol=2e-4)
    assert_allclose(a.alpha, b.alpha, atol=2e-4)


def test_pictures_are_the_same_every_time() -> None:
    tree = n3tree(splits=[(0, (1, 0, 1))])
    fields = build_field(tree), build_field(tree)
    camera = orbit_cameras(fields[0], width=33, height=31).cameras[0]
    pictures = {render_field(field, camera).colour.tobytes() for field in (*fields, fields[0])}
    assert len(pictures) == 1


def test_an_orbit_frames_everything() -> None:
    data = np.zeros((1, 2, 2, 2, 4), np.float32)
    data[0, 1, 1, 1, 3] = 1e6
    field = build_field(n3tree(data=data, data_format="RGBA", offset=np.full(3, 0.25), invradius=np.full(3, 0.1)))
    for camera in orbit_cameras(field, frames=7, width=60, height=40).cameras:
        alpha = render_field(field, camera).alpha
        assert alpha.max() > 0.99
        assert not alpha[[0, -1]].any()
        assert not alpha[:, [0, -1]].any()


def test_what_cannot_be_rendered_is_refused() -> None:
    with pytest.raises(InvalidScene, match="data_format is SG1; allowed: SHk or RGBA"):
        build_field(n3tree(data_format="SG1"))
    with pytest.raises(InvalidScene, match="transmittance_cut is 1; allowed: 0 to 1"):
        render_field(solid(1.0), front(), transmittance_cut=1)
    broken = n3tree()
    broken.data[0, 0, 0, 0, 0] = np.nan
    with pytest.raises(InvalidScene, match="is nan"):
        build_field(broken)


def test_a_scene_that_is_no_field_yet_says_what_makes_one() -> None:
    scene: Any = n3tree()
    for asked in (lambda: render_field(scene, front()), lambda: orbit_cameras(scene)):
        with pytest.raises(UsageError, match=r"^N3Tree is not a RadianceField; allowed: the result of build_field\(\)"):
            asked()
    picture: Any = render_field(solid(1.0), front())
    known = "N3Tree, SparseVoxelOctree, Volume, BrickField"
    with pytest.raises(UsageError, match=f"^Image has no radiance field; allowed: {known}$"):
        build_field(picture)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"focal": 0.0}, "focal length 0"),
        ({"focal": np.nan}, "focal length nan"),
        ({"width": 0}, "0x4 pixels"),
        ({"pose": np.zeros((4, 4))}, "singular"),
        ({"pose": np.full((4, 4), np.nan)}, "NaN"),
        ({"pose": np.eye(3)}, "shape"),
    ],
)
def test_cameras_that_see_nothing_are_refused(wrong: dict[str, object], message: str) -> None:
    fields: dict[str, object] = {"width": 4, "height": 4, "focal": 3.0, "pose": np.eye(4)}
    with pytest.raises(InvalidScene, match=message):
        Camera(**(fields | wrong))  # type: ignore[arg-type]


def test_a_ray_ends_at_what_stands_in_its_way() -> None:
    stop = np.full((5, 5), np.inf)
    stop[2, 2], stop[2, 1] = 2.75, 1.0  # a quarter into the box, and before it
    for lookup in ("nearest", "trilinear"):
        image = render_field(solid(3.0), front(), transmittance_cut=0, stop=stop, lookup=lookup)
        if lookup == "nearest":
            assert_allclose(image.alpha[2, 2], 1 - np.exp(-0.75), rtol=1e-4)
            assert_allclose(image.alpha[2, 3], 1 - np.exp(-3), rtol=1e-3)
        assert image.alpha[2, 1] == 0
        assert image.alpha[2, 2] < image.alpha[2, 3]
        assert image.depth[2, 2] < 2.75
    with pytest.raises(InvalidScene, match="stop has shape"):
        render_field(solid(3.0), front(), stop=np.ones((4, 5)))


def test_a_ray_along_a_boundary_is_not_held_up() -> None:
    # In the plane between two cells, and along the edge of four, whatever way rounding leans.
    field = build_field(n3tree(splits=[(0, (1, 0, 1)), (1, (1, 1, 1))], data_format="SH1"))
    for lean in (0.0, 1e-17, -1e-17, 1e-12):
        pose = np.eye(4)
        pose[:3, :3] = look_at(np.zeros(3), -np.pi / 2 + lean, lean, 1.0)[:3, :3]
        pose[:3, 3] = 0.5, -2.0, 0.5
        image = render_field(field, Camera(3, 3, 1e6, pose), transmittance_cut=0)
        assert np.isfinite(image.colour).all()
        assert_allclose(image.alpha[0], image.alpha[0, 0], atol=0.7)


# -- trilinear -------------------------------------------------------------------------------------------------
def test_density_between_centres_is_a_straight_line() -> None:
    # Head on, the ray sees tents of a cell's density each, two cells wide: they add up to density times width.
    sigma = np.array([0, 5.0, 1.0, 0, 0, 2.0, 7.0, 0.5])
    data = np.zeros((1, 8, 8, 8, 4), np.float32)
    data[..., 3] = sigma[:, None]
    field = build_field(n3tree(N=8, data=data, data_format="RGBA"))
    image = render_field(field, front(), transmittance_cut=0, lookup="trilinear")
    assert_allclose(image.alpha[2, 2], 1 - np.exp(-sigma.sum() / 8), rtol=1e-5)


def test_what_is_empty_has_no_colour_to_mix_in() -> None:
    data = np.zeros((1, 8, 8, 8, 4), np.float32)
    data[0, 2:5, 2:5, 2:5] = 1.0, -2.0, 0.5, 4.0
    field = build_field(n3tree(N=8, data=data, data_format="RGBA"))
    image = render_field(field, front(9), background=None, lookup="trilinear")
    seen = image.colour[image.alpha > 1e-3] / image.alpha[image.alpha > 1e-3, None]
    assert len(seen) > 9
    assert_allclose(seen, np.broadcast_to(1 / (1 + np.exp([-1.0, 2.0, -0.5])), seen.shape), rtol=1e-3)


@pytest.mark.parametrize("N", [2, 3])
def test_trilinear_is_what_sample_says(N: int) -> None:
    tree = n3tree(splits=[(0, (1, 0, 1)), (1, (1, 1, 1))], N=N, data_format="SH1", dtype=np.float32)
    tree.data[0, 1, 0, 0, -1] = 0  # a large empty cell, to be jumped over
    octree = build_octree(tree, resample="nearest")
    field = build_field(tree)
    camera = orbit_cameras(field, width=7, height=7).cameras[0]
    image = render_field(field, camera, transmittance_cut=0, lookup="trilinear")
    origin, looks = camera.rays()
    width = 1 / N**3
    t = np.arange(0, 2 * np.linalg.norm(origin - 0.5), width / 20)
    sigma = octree.sample(origin + looks[:, None] * t[:, None], lookup="trilinear")[..., -1]
    # sample() ends at the grid's faces, the tents half a cell beyond.
    inside = image.alpha.reshape(-1)
    assert_allclose(inside, 1 - np.exp(-sigma.sum(axis=1) * width / 20), atol=0.02)
    assert inside.max() > 0.3


# -- volumes ---------------------------------------------------------------------------------------------------
