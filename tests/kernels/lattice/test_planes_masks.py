"""Masks: cells beside a node, and the nodes that what lies in some cells is made of."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from nerfbake.kernels.lattice.planes import nodes_around, touched_cells


def test_a_node_touches_eight_cells_even_at_the_end() -> None:
    nodes = np.zeros((2, 3, 4), bool)
    nodes[1, 1, 3] = True
    expected = np.zeros((3, 4, 5), bool)
    expected[1:, 1:3, 3:] = True
    assert_array_equal(touched_cells(nodes), expected)


@pytest.mark.parametrize("at_corners", [True, False])
def test_nodes_matter_where_a_cell_is_nearer_than_the_next_node(at_corners: bool) -> None:
    random, shape = np.random.default_rng(3), (5, 7, 4)
    box, own = np.array([[0.0, 1, 2], [4.0, 3, 5]]), np.array([[-1.0, 1.25, 2.5], [3.5, 4, 4.5]])
    cells = random.random((6, 5, 4)) < 0.04
    found = nodes_around(cells, box, own, shape, at_corners=at_corners)
    apart = (box[1] - box[0]) / (np.array(shape) - at_corners)
    nodes = box[0] + apart * (np.argwhere(np.ones(shape, bool)) + (0 if at_corners else 0.5))
    edges = (own[1] - own[0]) / cells.shape
    low = own[0] + np.argwhere(cells) * edges
    beyond = np.maximum(low - nodes[:, None], nodes[:, None] - low - edges)
    assert_array_equal(found.reshape(-1), (beyond < apart - 1e-9).all(axis=2).any(axis=1))
    assert 0 < np.count_nonzero(found) < found.size
