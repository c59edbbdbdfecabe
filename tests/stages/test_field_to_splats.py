"""Leaves as splats: places, sizes, opacities and colours by hand, and the choice of leaves."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from nerfbake import build_field, build_splats, orbit_cameras, render_field, render_splats, sample_n3tree
from nerfbake.errors import InvalidScene
from nerfbake.kernels.march.sh import sh_basis
from nerfbake.kernels.maths.elementary import fibonacci
from nerfbake.kernels.picture.metrics import psnr
from nerfbake.stages.field_to_splats import _quaternion
from tests.support.scenes import n3tree
from tests.support.splat_pictures import covariances
from tests.support.splats import splats


def test_one_leaf_by_hand() -> None:
    tree = n3tree(data_format="RGBA")
    tree.data[...] = 0
    tree.data[0, 1, 0, 1] = [2.0, 0.0, -2.0, 5.0]
    field = build_field(tree)
    made = build_splats(field)
    assert made.n == 1
    centre = field.world(np.array([[1.5, 0.5, 1.5]]) * field.cells.edge / 2)
    edge = float(np.abs(field.world(np.eye(3)[:1] * field.cells.edge / 2) - field.world(np.zeros((1, 3)))).max())
    assert_allclose(made.means, centre, rtol=1e-6)
    assert_allclose(made.scales, 0.33 * edge, rtol=1e-6)
    assert_allclose(made.opacity, 1 - np.exp(-5 * edge), rtol=1e-5)
    colours = np.maximum(made.sh[:, 0] * 0.28209479 + 0.5, 0)
    assert_allclose(colours[0], 1 / (1 + np.exp([-2.0, 0, 2])), rtol=1e-5)


def test_colours_are_those_of_the_leaves_in_every_direction() -> None:
    field = build_field(sample_n3tree(resolution=16, basis="SH9"))
    ways = fibonacci(50)
    made = build_splats(field)
    shown = np.einsum("nbc,db->ndc", made.sh, sh_basis(ways, made.B)) + 0.5
    values = field.sample(made.means.astype(np.float64))
    theirs = np.einsum("ncb,db->ndc", values[:, :-1].reshape(len(values), 3, -1), sh_basis(ways, 9))
    assert np.sqrt(((shown - 1 / (1 + np.exp(-theirs))) ** 2).mean()) < 0.01


def test_the_splats_look_like_the_field() -> None:
    field = build_field(sample_n3tree(resolution=32))
    camera = orbit_cameras(field, width=64, height=64).cameras[0]
    seen = render_splats(build_splats(field), camera).colour.astype(np.float64)
    assert psnr(seen, render_field(field, camera, samples=2).colour.astype(np.float64)) > 24


def test_fewer_splats_are_the_most_visible_ones_and_grow() -> None:
    field = build_field(sample_n3tree(resolution=16))
    every, few = build_splats(field), build_splats(field, count=100)
    assert few.n == 100
    assert_allclose(few.scales[0, 0] / every.scales[0, 0], min(np.sqrt(every.n / 100), 2.5), rtol=1e-5)
    assert {tuple(mean) for mean in few.means.tolist()} < {tuple(mean) for mean in every.means.tolist()}


def test_what_cannot_become_splats_is_one_line() -> None:
    field = build_field(sample_n3tree(resolution=8))
    with pytest.raises(InvalidScene, match="count is 0; allowed: 1 or more"):
        build_splats(field, count=0)
    thin = replace(field, values=field.values * np.append(np.ones(field.values.shape[1] - 1), 0).astype(np.float32))
    with pytest.raises(InvalidScene, match="shows nothing in any picture"):
        build_splats(thin)


def test_a_turned_field_has_turned_splats() -> None:
    random = np.random.default_rng(0)
    one = splats(1)
    for _ in range(50):
        axes, _ = np.linalg.qr(random.normal(size=(3, 3)))
        quat = _quaternion(axes).astype(np.float32)
        scales = np.array([[1, 2, 3]], np.float32)
        made = covariances(replace(one, scales=scales, quats=quat[None]))[0]
        assert_allclose(made, axes.T @ np.diag([1, 4, 9]) @ axes, atol=1e-5)
    for k in range(3):  # half turns, where the scalar part is 0
        assert_allclose(
            np.abs(_quaternion(np.diag(np.where(np.arange(3) == k, 1.0, -1)))), np.eye(4)[k + 1], atol=1e-12
        )
