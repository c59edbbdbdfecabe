from __future__ import annotations

from dataclasses import replace

import numpy as np
from hypothesis import given, settings

from nerfbake import (
    RadianceField,
    build_field,
    build_field_from_page,
    build_octree,
    build_page_field,
    orbit_cameras,
    render_field,
    round_field,
    round_to_bytes,
    sample_n3tree,
)
from nerfbake.scene.n3tree import N3Tree
from tests.support.fields import assert_same_samples
from tests.support.scenes import n3tree, n3trees


def assert_comes_back(field: RadianceField) -> None:
    assert_same_samples(build_field_from_page(build_page_field(field)), field)


@settings(max_examples=30)
@given(n3trees())
def test_every_voxel_is_what_the_field_said_that_the_page_was_made_of(tree: N3Tree) -> None:
    if tree.data_format not in ("SG2", "ASG2") and (tree.sigma[tree.leaf_mask] > 0).any():
        assert_comes_back(build_field(tree))


def test_so_it_is_in_a_box_that_is_no_cube() -> None:
    assert_comes_back(build_field(build_octree(sample_n3tree(resolution=32, basis="SH4"), resolution=(24, 32, 17))))


def test_a_cell_that_is_one_row_is_the_whole_tree() -> None:
    # A root of one node whose only leaf is 8 cells wide.
    tree = n3tree()
    tree.data[..., -1] = 0
    tree.data[0, 0, 0, 0, -1] = 3
    field = build_field(tree)
    wide = field.cells._replace(edge=16, width=np.array([8.0]), shift=np.array([3]))
    assert_comes_back(replace(field, cells=wide, box=np.array([[0.0] * 3, [8.0] * 3])))


def test_pictures_are_the_same() -> None:
    field = build_field(sample_n3tree(resolution=16))
    camera = orbit_cameras(field, width=40, height=40).cameras[0]
    made, wanted = (
        render_field(build_field_from_page(build_page_field(field)), camera),
        render_field(round_field(field), camera),
    )
    # Leaves are cut into voxels, so that a ray may end a little earlier, where no more than 1e-4 of the light is left.
    assert np.abs(made.colour - wanted.colour).max() <= 1e-4


def test_bytes_by_hand() -> None:
    field = build_field(n3tree(splits=[], data_format="RGBA"))
    values = np.zeros((len(field.values), 4), np.float32)
    values[:3] = np.array([[0, 10, 7, 1], [1, 11, 7, 2], [0.5, 12.55, 7, 3]])
    values[3:] = values[0]
    found = round_to_bytes(replace(field, values=values)).values
    # Widths of red, green and blue are 1, 2.55 and 0; the widest, in 255 steps, is a hundredth a step.
    np.testing.assert_allclose(found[:3], values[:3], atol=1e-6)
    values[1, 0] = 0.504
    np.testing.assert_allclose(round_to_bytes(replace(field, values=values)).values[1, 0], 0.5, atol=1e-6)
