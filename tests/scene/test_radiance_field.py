"""The field that pictures are made of, built by hand: it needs no file and no scene."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from nerfbake import RadianceField, build_field, memory_limit, orbit_cameras, render_field
from nerfbake.errors import InvalidScene, MemoryLimit
from nerfbake.kernels.march.cells import EMPTY, cells_of
from nerfbake.memory import left, size_of
from nerfbake.scene.basis import Basis
from nerfbake.scene.radiance_field import leaf_box, leaves_of
from tests.support.scenes import n3tree


def one_leaf(**fields: Any) -> RadianceField:
    """Eight cells of the unit cube, of which only that at x = 1, y = 0, z = 1 is filled."""
    slots = np.full((1, 8), EMPTY, np.int32)
    slots[0, 0b101] = -2
    cells = cells_of(slots, [1])
    values = np.array([[2, 0, 0, 1e6]], np.float32)
    made: dict[str, Any] = {"cells": cells, "values": values, "place": 2 * np.eye(3, 4), "box": leaf_box(cells)}
    return RadianceField(**(made | {"basis": Basis("RGBA", 1)} | fields))


def test_a_field_without_a_scene_is_seen_and_sampled() -> None:
    field = one_leaf()
    assert_array_equal(field.box, [[1, 0, 1], [2, 1, 2]])
    assert_allclose(field.leaf_centres(10), [[0.75, 0.25, 0.75]])
    assert_array_equal(field.sample(np.array([[0.6, 0.4, 0.9], [0.4, 0.4, 0.9]])), [[2, 0, 0, 1e6], [0, 0, 0, 0]])
    image = render_field(field, orbit_cameras(field, width=9, height=9).cameras[0])
    assert_allclose(image.alpha[4, 4], 1)
    assert_allclose(image.colour[4, 4], [1 / (1 + np.exp(-2)), 0.5, 0.5], rtol=1e-5)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"values": np.zeros((1, 5), np.float32)}, r"the field's values has shape \(1, 5\).*allowed: \(1, 4\) float32"),
        ({"values": np.zeros((1, 4))}, "dtype float64; allowed"),
        ({"place": np.eye(3)}, r"the field's place has shape \(3, 3\)"),
        ({"box": np.zeros((3, 2))}, r"the field's box has shape \(3, 2\)"),
        ({"basis": Basis("SG", 1)}, "data_format is SG1; allowed: SHk or RGBA"),
    ],
)
def test_what_cannot_be_marched_is_refused(wrong: dict[str, Any], message: str) -> None:
    with pytest.raises(InvalidScene, match=message):
        one_leaf(**wrong)


def test_a_field_counts_for_as_long_as_it_lives() -> None:
    with memory_limit(3_500):
        field = build_field(n3tree(data_format="SH1"))
        assert left() == 3_500 - size_of(field)
        with pytest.raises(MemoryLimit, match=r"in addition to .* in use"):
            render_field(field, orbit_cameras(field, width=5, height=5).cameras[0])
        del field
        assert left() == 3_500


def test_leaves_are_the_same_whether_all_nodes_are_read_together_or_one_by_one() -> None:
    cells = build_field(n3tree([(0, (0, 0, 0)), (0, (1, 1, 1)), (1, (0, 1, 0))])).cells
    together, one_by_one = (list(leaves_of(cells, at_once)) for at_once in (None, 1))
    assert len(one_by_one) > len(together)
    whole, few = (
        np.concatenate([np.column_stack([corners, np.full(len(corners), width)]) for corners, width in found])
        for found in (together, one_by_one)
    )
    assert_array_equal(few, whole)
