from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from nerfbake.errors import InvalidScene
from nerfbake.scene.octree import SparseVoxelOctree
from nerfbake.stages.field_to_importance import Importance, weigh_leaves
from nerfbake.stages.n3tree_to_octree import build_octree
from nerfbake.stages.octree_to_compression import quantise_octree
from nerfbake.stages.octree_to_octree import lower_basis
from nerfbake.stages.scene_to_cameras import scatter_cameras
from nerfbake.stages.scene_to_field import build_field_from_octree
from nerfbake.stages.shapes_to_n3tree import sample_n3tree
from tests.support.scenes import n3tree

SPHERE = 1 / (4 * np.pi)


def even(octree: SparseVoxelOctree) -> Importance:
    """All leaves equally important, seen from everywhere."""
    B = octree.data_dim // 3
    leaves = int((octree.childless & (octree.sigma > 0)).sum())
    return Importance(np.ones(leaves, np.float32), np.eye(B) * (SPHERE if octree.data_format != "RGBA" else 1))


def leaf_values(octree: SparseVoxelOctree) -> np.ndarray:
    return octree.node_data[octree.childless]


@pytest.mark.parametrize("data_format", ["SH1", "SH4", "SH9", "SH16", "SH25", "RGBA"])
@pytest.mark.parametrize("resolution", [4, (4, 3, 2), 1])
def test_fine_steps_bring_every_leaf_back(data_format: str, resolution: int | tuple[int, int, int]) -> None:
    octree = build_octree(n3tree([(0, (1, 0, 1))], data_format=data_format), resolution=resolution)
    made = quantise_octree(octree, even(octree), step=1e-6)
    assert made.problems() == []
    back = made.restored()
    assert back.problems() == []
    assert_array_equal(back.node_children, octree.node_children)
    assert_allclose(leaf_values(back), leaf_values(octree), atol=2e-4)
    if resolution == 4:  # inner nodes are means with the width of a voxel, which is that of the tree's cells here
        assert_allclose(back.node_data, octree.node_data, atol=2e-4)
    assert back.size == octree.size
    assert_array_equal(back.origin, octree.origin)
    assert_array_equal(back.voxel_size, octree.voxel_size)
    assert back.data_format == data_format


@given(st.integers(0, 2**32), st.floats(0.01, 1))
def test_the_error_is_that_of_the_step(seed: int, step: float) -> None:
    octree = build_octree(sample_n3tree(resolution=16, basis="SH4"))
    random = np.random.default_rng(seed)
    octree = replace(octree, node_data=octree.node_data * random.uniform(0.5, 2, 13).astype(np.float32))
    back = quantise_octree(octree, even(octree), step=step).restored()
    seen = (leaf_values(back) - leaf_values(octree))[:, :-1].astype(np.float64) * np.sqrt(SPHERE)
    # Rounding makes a twelfth of the squared step in each of the channels, less where a step has nothing to round.
    assert (seen**2).sum(axis=1).mean() <= 12 * step**2 / 12 * 1.3


def test_the_least_important_leaves_go() -> None:
    octree = build_octree(n3tree([(0, (1, 0, 1))], data_format="SH1"), resolution=4)
    leaves = np.flatnonzero(octree.childless)
    importance = even(octree)
    importance.largest[:7] = 0.5
    importance.largest[2] = 2
    back = quantise_octree(octree, importance, step=1e-6, prune=6 / len(leaves) + 1e-9).restored()
    # What is left: the third leaf of the first level, and the eight below the node.
    assert back.level_sizes == [1, 2, 8]
    assert_allclose(leaf_values(back), octree.node_data[leaves[[2, *range(7, 15)]]], atol=1e-4)


def test_one_leaf_always_stays() -> None:
    octree = build_octree(n3tree(data_format="SH1"), resolution=2)
    assert quantise_octree(octree, even(octree), step=0.1, prune=1.0).m == 1


def test_both_layouts_are_the_same_file() -> None:
    octree = build_octree(n3tree([(0, (1, 0, 1))], data_format="SH1"), resolution=4)
    one = quantise_octree(octree.with_layout("full"), even(octree), step=0.1)
    other = quantise_octree(octree.with_layout("compact"), even(octree), step=0.1)
    assert_array_equal(one.masks, other.masks)
    assert_array_equal(one.values, other.values)


def test_larger_leaves_come_back_as_they_are() -> None:
    # Two equal halves of a cube are leaves of the first level among voxels.
    tree = n3tree([(0, (1, 0, 1))], data_format="SH1")
    octree = build_octree(tree, resolution=4)
    assert octree.level_sizes == [1, 8, 8]
    made = quantise_octree(octree, even(octree), step=0.01)
    assert made.level_sizes == [1, 8, 8]


@pytest.mark.parametrize("data_format", ["SG2", "ASG2"])
def test_bases_that_cannot_be_shown_are_refused(data_format: str) -> None:
    octree = build_octree(n3tree(data_format=data_format), resolution=2)
    with pytest.raises(InvalidScene, match=f"data_format is {data_format}"):
        quantise_octree(octree, even(octree), step=0.1)


def test_an_octree_that_holds_nothing_is_refused() -> None:
    octree = build_octree(n3tree(data_format="SH1"), resolution=2, sigma_min=1e6)
    with pytest.raises(InvalidScene, match="is empty"):
        quantise_octree(octree, even(octree), step=0.1)


def test_a_step_too_small_for_whole_numbers_is_refused() -> None:
    octree = build_octree(n3tree(data_format="SH1"), resolution=2)
    huge = replace(octree, node_data=octree.node_data * np.float32(1e6))
    with pytest.raises(InvalidScene, match="a step of 1e-06"):
        quantise_octree(huge, even(octree), step=1e-6)


def test_importance_is_the_same_for_any_number_of_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    field = build_field_from_octree(build_octree(sample_n3tree(resolution=16, basis="SH4")))
    cameras = scatter_cameras(field, frames=8, edge=24)
    found = []
    for threads in (1, 3, 8):
        monkeypatch.setattr("os.cpu_count", lambda threads=threads: threads)
        found.append(weigh_leaves(field, cameras))
    for other in found[1:]:
        assert_array_equal(other.largest, found[0].largest)
        assert_array_equal(other.gram, found[0].gram)


def test_what_stands_inside_is_not_important() -> None:
    field = build_field_from_octree(build_octree(sample_n3tree(resolution=16, basis="SH4")))
    largest = weigh_leaves(field, scatter_cameras(field, frames=16, edge=64)).largest
    assert largest.min() >= 0
    assert largest.max() <= 1
    assert (largest == 0).any()


def test_a_lower_basis_is_the_start_of_an_even_one() -> None:
    octree = build_octree(n3tree([(0, (1, 0, 1))], data_format="SH9"), resolution=4)
    lower = lower_basis(octree, "SH4", np.eye(9) * SPHERE)
    values = octree.node_data[:, :-1].reshape(-1, 3, 9)[..., :4].reshape(-1, 12)
    assert_allclose(lower.node_data[:, :-1], values, rtol=1e-6)
    assert_array_equal(lower.node_data[:, -1], octree.node_data[:, -1])


def test_a_lower_basis_is_the_least_squares_fit_over_what_is_seen() -> None:
    octree = build_octree(n3tree([(0, (1, 0, 1))], data_format="SH9"), resolution=4)
    random = np.random.default_rng(0)
    basis = random.normal(size=(200, 9))
    lower = lower_basis(octree, "SH4", basis.T @ basis / 200)
    for c in range(3):
        seen = basis @ octree.node_data[:, c * 9 : c * 9 + 9].T.astype(np.float64)
        best, *_ = np.linalg.lstsq(basis[:, :4], seen, rcond=None)
        assert_allclose(lower.node_data[:, c * 4 : c * 4 + 4].T, best, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("basis", ["SH16", "SH3", "RGBA", "SG4"])
def test_a_higher_or_another_basis_is_refused(basis: str) -> None:
    octree = build_octree(n3tree(data_format="SH9"), resolution=2)
    with pytest.raises(InvalidScene, match=f"the basis is {basis} for an octree of SH9; allowed: SH1, SH4"):
        lower_basis(octree, basis, np.eye(9))
