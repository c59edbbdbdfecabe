"""Values between the nodes of a lattice, against sums over all of its nodes."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from nerfbake.kernels.lattice.nodes import (
    RELU,
    SOFTPLUS,
    DensityNodes,
    cells_in,
    densities,
    in_nodes,
    interpolate_rows,
    nearest_in,
    softplus_of,
    thickness_of,
)

SHAPE = (5, 6, 7)
RANDOM = np.random.default_rng(2)
LINKS = np.where(RANDOM.random(SHAPE) < 0.3, -2, np.arange(210).reshape(SHAPE)).astype(np.int32)
DENSITY = RANDOM.normal(0, 3, 210).astype(np.float32)
EVERYWHERE = np.ones((1, 1, 1), bool)


def hats(at: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """(m, X, Y, Z) what each node weighs at each place: the product of three hats, worked out for all nodes."""
    x, y, z = (np.maximum(1 - np.abs(at[:, [axis]] - np.arange(edge)), 0) for axis, edge in enumerate(SHAPE))
    return np.asarray(np.einsum("mx,my,mz->mxyz", x, y, z))


def places(corners: bool) -> npt.NDArray[np.float64]:
    """Anywhere, at the box's corners, and at its faces."""
    ends = np.stack(np.meshgrid([0.0, 1.0], [0.0, 1.0], [0.0, 1.0]), -1).reshape(-1, 3)
    faces = RANDOM.random((30, 3))
    faces[np.arange(30), np.arange(30) % 3] = np.arange(30) % 2
    return np.concatenate([RANDOM.random((200, 3)), ends, faces])


@pytest.mark.parametrize("corners", [False, True])
def test_values_are_the_sums_of_all_nodes_by_their_hats(corners: bool) -> None:
    where = places(corners)
    at = in_nodes(where, SHAPE, corners)
    if corners:
        assert_allclose(at, where * (np.array(SHAPE) - 1))
    else:  # half a cell before the box's end the last node goes on
        assert_allclose(at, np.clip(where * SHAPE - 0.5, 0, np.array(SHAPE) - 1))
    weights = hats(at) * (LINKS >= 0)
    table = RANDOM.normal(0, 1, (210, 4)).astype(np.float32)
    assert_allclose(interpolate_rows(LINKS, table, at), np.einsum("mxyz,xyzc->mc", weights, table[LINKS]), atol=2e-6)
    raw = np.einsum("mxyz,xyz->m", weights, DENSITY[LINKS])
    met = (hats(at) > 0)[:, LINKS >= 0].any(axis=1)
    nodes = DensityNodes(LINKS, DENSITY, EVERYWHERE, *nearest_in(EVERYWHERE), int(corners), RELU, 0.0, 2.0, 0.0)
    assert_allclose(densities(nodes, where), np.where(met, 2 * np.maximum(raw, 0), 0), atol=1e-5)
    soft = nodes._replace(kind=SOFTPLUS, shift=-1.5, least=0.125)
    wanted = 2 * np.log1p(np.exp(raw - 1.5))
    clear = np.abs(wanted - 0.125) > 1e-4
    found = densities(soft, where)
    assert_allclose(found[clear], np.where(met & (wanted > 0.125), wanted, 0)[clear], rtol=1e-5, atol=1e-6)


def test_a_mask_counts_at_its_nearest_node() -> None:
    mask = np.zeros((3, 2, 2), bool)
    mask[1] = True
    full = np.arange(210, dtype=np.int32).reshape(SHAPE)
    nodes = DensityNodes(full, np.ones(210, np.float32), mask, *nearest_in(mask), 1, RELU, 0.0, 1.0, 0.0)
    x = np.array([0.0, 0.2499, 0.2501, 0.5, 0.7499, 0.7501, 1.0])
    where = np.column_stack([x, np.full(7, 0.3), np.full(7, 0.9)])
    assert_array_equal(densities(nodes, where), [0, 0, 1, 1, 1, 0, 0])


def test_the_softplus_is_exact_where_it_is_small() -> None:
    x = np.array([-700.0, -90.0, -30.0, -5.0, -0.5, 0.0, 0.5, 7.0, 90.0])
    found = np.array([softplus_of(each) for each in x])
    assert_allclose(found, np.logaddexp(0, x), rtol=1e-12)


def test_a_mask_may_be_of_cells_in_a_box_of_its_own() -> None:
    """Cells of half a unit from -0.5 to 1.5, the lattice's box being 0 to 2 along x: beyond 1.5 nothing counts."""
    mask = np.zeros((4, 1, 1), bool)
    mask[[1, 3]] = True
    box, own = np.array([[0.0, 0, 0], [2, 1, 1]]), np.array([[-0.5, 0, 0], [1.5, 1, 1]])
    full = np.arange(210, dtype=np.int32).reshape(SHAPE)
    nodes = DensityNodes(full, np.ones(210, np.float32), mask, *cells_in(mask, box, own), 1, RELU, 0.0, 1.0, 0.0)
    x = np.array([0.0, 0.24, 0.26, 0.49, 0.51, 0.7, 0.75, 0.76, 1.0])
    where = np.column_stack([x, np.full(9, 0.3), np.full(9, 1.0)])
    assert_array_equal(densities(nodes, where), [1, 1, 0, 0, 1, 1, 1, 0, 0])


def test_an_opacity_is_a_thickness_up_to_the_last_byte() -> None:
    opacity = np.array([-0.5, 0.0, 1e-6, 0.1, 0.5, 0.9, 0.998, 0.999, 1.0, 3.0])
    found = np.array([thickness_of(each) for each in opacity])
    assert_allclose(found, -np.log(np.maximum(1 - np.maximum(opacity, 0), 1 / 510)), rtol=1e-11, atol=1e-15)
