"""A lattice whose nodes stand in blocks, with planes: what it asks of its parts."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

from nerfbake import LatticeField
from nerfbake.errors import InvalidScene
from nerfbake.scene.lattice_field import Activation, Blocks, DeferredColour, Planes, RgbColour

BOX = np.array([[-1.0] * 3, [1.0] * 3])


def lattice(**fields: Any) -> LatticeField:
    """Two blocks of 2^3 cells in 3x1x2, over a box that reaches beyond the lattice's; planes of 5 nodes."""
    links = np.array([[[0, -1]], [[-1, -1]], [[-1, 27]]], np.int32)
    known: dict[str, Any] = {
        "links": links,
        "density": np.zeros(54, np.float32),
        "features": np.zeros((54, 7), np.float32),
        "activation": Activation("exponential", -1.0, 1.0),
        "colour": DeferredColour(None, squashed=True),
        "box": BOX,
        "blocks": Blocks(2, np.array([[-1.5, -1.0, -1.0], [1.5, 2.0, 1.0]])),
        "planes": Planes(np.zeros((3, 5, 5), np.float32), np.zeros((3, 5, 5, 7), np.float32), 0.25, 3.5),
    }
    return LatticeField(**(known | fields))


def test_cells_are_those_of_the_planes_or_else_of_the_blocks() -> None:
    fine, coarse = lattice(), lattice(planes=None)
    assert (fine.cells, fine.shape, coarse.cells) == ((4, 4, 4), (4, 4, 4), (4, 2, 4))
    assert_allclose(fine.spacing, 2 / 3.5)
    assert_allclose(coarse.spacing, [0.5, 1.5, 0.5])
    assert str(fine) == "lattice field of 4x4x4, 54 nodes, RGB"


def test_what_is_held_is_in_blocks_and_in_the_box() -> None:
    assert_allclose(lattice().held_box, BOX)
    one = lattice(links=np.array([[[-1, -1]], [[-1, 0]], [[-1, -1]]], np.int32))
    assert_allclose(one.held_box, [[-0.5, -1, 0], [0.5, 1, 1]])
    assert_allclose(one.scaled(2.0).held_box, [[-1, -2, 0], [1, 2, 2]])


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"blocks": Blocks(0, BOX)}, "the blocks are 0 cells wide; allowed: 1 to 254"),
        ({"blocks": Blocks(2, BOX[:1])}, "the blocks' box has shape"),
        ({"colour": RgbColour(7)}, "the blocks hold RGB; allowed: a deferred colour"),
        ({"blocks": None}, "the planes are set for nodes that are not in blocks; allowed: nodes in blocks"),
        (
            {"planes": Planes(np.zeros((3, 5, 4), np.float32), np.zeros((3, 5, 5, 7), np.float32), 0, 1)},
            "planes' density",
        ),
        (
            {"planes": Planes(np.zeros((3, 5, 5), np.float32), np.zeros((3, 5, 5, 6), np.float32), 0, 1)},
            "planes' colours",
        ),
        ({"planes": lattice().planes._replace(across=4.0)}, "5 nodes, and the box starts at 0.25 and is 4 wide"),  # type: ignore[union-attr]
    ],
)
def test_parts_that_do_not_fit_are_refused(fields: dict[str, Any], message: str) -> None:
    with pytest.raises(InvalidScene, match=message):
        lattice(**fields)


def test_blocks_and_numbers_that_cannot_be_are_told() -> None:
    links = lattice().links.copy()
    links[1, 0, 1] = 28
    (problem,) = lattice(links=links).problems()
    assert problem.line == "links[1, 0, 1] is 28; allowed: below 28, the rows of values"
    planes = lattice().planes
    assert planes is not None
    planes.features[1, 2, 3, 4] = np.nan
    (problem,) = replace(lattice(), planes=planes).problems()
    assert problem.line == "the planes' colours[1, 2, 3, 4] is nan; allowed: a finite number"
    broken = lattice(density=np.full(54, np.inf, np.float32)).problems()
    assert broken[0].line.startswith("density[0] is inf")
    (problem,) = lattice(blocks=Blocks(2, BOX[::-1].copy())).problems()
    assert problem.line.startswith("the blocks' edges")
