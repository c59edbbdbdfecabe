"""The field of a lattice: its sizes, its place in the world, and what is wrong with it."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from nerfbake.errors import InvalidScene
from nerfbake.scene.lattice_field import Activation, ShColour
from tests.support.lattices import CENTRE, RADIUS, SHAPE, some_lattice


def test_cells_and_spacing_hang_on_where_nodes_stand() -> None:
    inside, on = some_lattice(), some_lattice(at_corners=True)
    assert (inside.cells, on.cells) == (SHAPE, (4, 5, 6))
    assert_allclose(inside.spacing, 2 * RADIUS / SHAPE)
    assert_allclose(on.spacing, 2 * RADIUS / (4, 5, 6))
    assert on.step == pytest.approx(on.spacing.min() / 2)


def test_what_is_held_is_framed() -> None:
    links = np.full(SHAPE, -1, np.int32)
    links[1, 2, 3] = 0
    low, edges = CENTRE - RADIUS, 2 * RADIUS
    cell = some_lattice(links=links).held_box
    assert_allclose(cell, low + edges * [[1 / 5, 2 / 6, 3 / 7], [2 / 5, 3 / 6, 4 / 7]], atol=1e-7)
    around = some_lattice(links=links, at_corners=True).held_box
    assert_allclose(around, low + edges * [[0, 1 / 5, 2 / 6], [2 / 4, 3 / 5, 4 / 6]], atol=1e-7)
    assert_array_equal(some_lattice(links=np.full(SHAPE, -1, np.int32)).held_box, some_lattice().box)


def test_a_larger_world_is_as_dense_in_all() -> None:
    small = some_lattice(activation=Activation("softplus", -2.0, 8.0))
    large = small.scaled(4.0)
    assert_array_equal(large.box, 4 * small.box)
    assert large.activation == Activation("softplus", -2.0, 2.0)


@pytest.mark.parametrize(
    ("fields", "said"),
    [
        ({"links": np.zeros((2, 2), np.int32)}, "links has shape"),
        ({"links": np.zeros((1, 2, 2), np.int32), "at_corners": True}, "2 to 4096 nodes per axis"),
        ({"features": np.zeros((3, 3), np.float32)}, "colours has shape"),
        ({"colour": ShColour(5), "features": np.zeros((210, 15), np.float32)}, "5 coefficients a channel"),
        ({"density": np.zeros(210)}, "density has shape"),
        ({"occupied": np.zeros((0, 1, 1), bool)}, "the mask has shape"),
    ],
)
def test_arrays_that_do_not_fit_are_refused(fields: dict[str, Any], said: str) -> None:
    with pytest.raises(InvalidScene, match=said):
        some_lattice(**fields)


def test_problems_are_told_where_a_node_has_them() -> None:
    lattice = some_lattice()
    assert lattice.problems() == []
    links = lattice.links.copy()
    links[4, 5, 6] = 210
    (problem,) = replace(lattice, links=links).problems()
    assert problem.place == "links[4, 5, 6]"
    density = lattice.density.copy()
    density[7] = np.nan
    (problem,) = replace(lattice, density=density).problems()
    assert problem.place == "density[7]"
    unlinked = np.where(lattice.links == 7, -1, lattice.links).astype(np.int32)
    assert replace(lattice, density=density, links=unlinked).problems() == []
    (problem,) = replace(lattice, activation=Activation("relu", np.nan)).problems()
    assert problem.place == "activation[0]"
    assert replace(lattice, box=lattice.box[::-1].copy()).problems()[0].place.startswith("the lattice's edges")
