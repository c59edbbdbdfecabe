"""The shells of a page: the same cells as in the tree, around an empty middle, with one colour in all directions."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from nerfbake import Camera, Cameras, HeldOut, N3Tree, Page, build_field, build_page_field, render_field
from nerfbake.formats.page.view import encode
from nerfbake.kernels.maths.elementary import sigmoid
from nerfbake.stages._basis_functions import basis_at
from nerfbake.stages.brick_field_to_n3tree import build_n3tree
from nerfbake.stages.n3tree_to_page_shells import build_page_shells
from tests.support.brick_fields import some_shelled_field

EYES = np.array([[0.2, 0.1, 0.3], [-0.4, 0.2, 0.1]])


def tree_of(basis: int) -> N3Tree:
    return build_n3tree(some_shelled_field(basis=basis), dtype="float32")


def points_in(tree: N3Tree, shell: int) -> Any:
    """World points in a shell, 0 the inner cube, which lies in -1..1."""
    points = np.random.default_rng(shell).uniform(-1, 1, (4000, 3)) * 2**shell
    return points[(np.abs(points) > 2 ** (shell - 1)).any(axis=1)] if shell else points


def test_each_shell_has_the_cells_of_the_tree_and_nothing_in_its_middle() -> None:
    tree = tree_of(1)
    shells = build_page_shells(tree)
    assert [shell.top.shape for shell in shells] == [(16, 16, 16)] * 2
    for number, shell in enumerate(shells, start=1):
        own = points_in(tree, number)
        found, wanted = shell.sample(own), tree.sample(own)
        assert (wanted[:, -1] > 0).sum() > 50
        assert_allclose(found[:, -1], wanted[:, -1], rtol=1e-3)
        held = wanted[:, -1] > 0
        assert_allclose(found[held], wanted[held], rtol=2e-3, atol=1e-3)
        for smaller in range(number):
            assert (shell.sample(points_in(tree, smaller))[:, -1] == 0).all()


def test_a_coarser_shell_has_the_means() -> None:
    tree = tree_of(1)
    fine, coarse = build_page_shells(tree)[0], build_page_shells(tree, resolution=32)[0]
    corners = np.stack(np.meshgrid(*[np.arange(32)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    parts = np.stack(np.meshgrid(*[(np.arange(4) + 0.5) / 4] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    world = (corners[:, None] + parts) / 8 - 2
    densities = fine.sample(world.reshape(-1, 3))[:, -1].reshape(len(corners), -1)
    assert_allclose(coarse.sample(world[:, 0])[:, -1], densities.mean(axis=1), rtol=2e-3, atol=1e-4)


def test_colours_are_the_means_of_what_the_cameras_see() -> None:
    poses = [np.eye(4), np.eye(4)]
    for pose, eye in zip(poses, EYES, strict=True):
        pose[:3, 3] = eye
    cameras = Cameras(tuple(Camera(8, 8, 4.0, pose, str(i)) for i, pose in enumerate(poses)))
    held_out = HeldOut.of(cameras, [np.zeros((8, 8, 3))] * 2)
    tree = replace(tree_of(4), held_out=held_out)
    (shell, _), basis = build_page_shells(tree), build_field(tree).basis
    # Both cameras look along -z and see what lies there; neither sees what lies at +z, where both count.
    own = points_in(tree, 1)
    own = own[(np.abs(own[:, 2]) > 1.8)]
    centres = (np.floor(own * 32) + 0.5) / 32  # of the narrow cells
    values = tree.sample(own)
    narrow = (values[:, -1] > 0) & (tree.sample(centres) == values).all(axis=1)
    found = shell.sample(own)
    assert_array_equal(found[:, [1, 2, 3, 5, 6, 7, 9, 10, 11]], 0)
    wanted = np.zeros((len(own), 3))
    for eye in EYES:
        along = centres - eye
        along /= np.linalg.norm(along, axis=1, keepdims=True)
        wanted += sigmoid((values[:, :-1].reshape(-1, 3, 4) * basis_at(basis, along)[:, None]).sum(axis=2)) / 2
    seen = sigmoid(found[:, [0, 4, 8]] * 0.28209479177387814)
    # Wide cells have another centre, so that a few directions differ.
    assert narrow.sum() > 10
    assert np.median(np.abs(seen - wanted)[narrow]) < 0.01


@pytest.mark.parametrize("shells", [2, 3])
def test_empty_shells_have_no_rows(shells: int) -> None:
    tree = tree_of(1)
    data = tree.data.copy()
    data[..., -1] = 0
    empty = build_page_shells(replace(tree, data=data))
    assert [len(shell.texels) for shell in empty] == [0, 0]
    assert (empty[shells - 2].top < 0).all()
    field = build_field(tree.inner_cube())
    cover = render_field(field, Camera(8, 8, 8.0, np.eye(4), "a"))
    page = Page(build_page_field(field), field, Cameras((Camera(8, 8, 8.0, np.eye(4)),)), cover, around=empty)
    assert b'"around"' in b"".join(encode(page))


def test_a_tree_without_scenery_has_no_shells() -> None:
    assert build_page_shells(tree_of(1).inner_cube()) == ()


def test_the_tree_itself_is_not_changed() -> None:
    tree = tree_of(4)
    child, data = tree.child.copy(), tree.data.copy()
    build_page_shells(tree)
    assert_array_equal(tree.child, child)
    assert_array_equal(tree.data, data)
    assert render_field(build_field(tree), Camera(8, 8, 8.0, np.eye(4), "a")).alpha.max() > 0
