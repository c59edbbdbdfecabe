"""An octree as a lattice with an MLP: what its nodes hold, worked out by hand, and what it looks like."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from nerfbake import LatticeField, SparseVoxelOctree, build_lattice, build_octree, measure_lattice, sample_n3tree
from nerfbake.errors import InvalidScene
from nerfbake.kernels.lattice.nodes import densities
from nerfbake.scene.lattice_field import MlpColour
from nerfbake.stages import octree_to_lattice as colours
from nerfbake.stages import octree_to_lattice as stage
from nerfbake.stages._lattice import nodes_of, places_of
from nerfbake.stages.octree_to_lattice import FEATURES
from tests.support.scenes import n3tree

ORIGIN = np.array([0.25, -0.5, 1.0])


@pytest.fixture(scope="module", autouse=True)
def _small() -> Iterator[None]:
    """Fewer and smaller pictures, and fewer colours, than real scenes need."""
    with pytest.MonkeyPatch.context() as patch:
        for module, name, value in ((stage, "_FRAMES", 6), (stage, "_EDGE", 32), (colours, "_ROWS", 2048)):
            patch.setattr(module, name, value)
        yield


def voxels(values: dict[tuple[int, int, int], list[float]], size: int = 16, **fields: Any) -> SparseVoxelOctree:
    """A tree of single voxels, in halves of the world's unit."""
    tree = [[0] * 8]
    depth, rows = (size - 1).bit_length(), {(0, 0, 0, 0): 0}
    for level in range(1, depth + 1):
        for place in sorted({tuple(c >> depth - level for c in voxel) for voxel in values}):
            x, y, z = place
            parent = rows[(level - 1, x >> 1, y >> 1, z >> 1)]
            rows[(level, x, y, z)] = len(tree)
            tree[parent][(x & 1) + 2 * (y & 1) + 4 * (z & 1)] = len(tree)
            tree.append([0] * 8)
    width = len(next(iter(values.values())))
    data = np.zeros((len(tree), width), np.float32)
    for place, own in values.items():
        data[rows[(depth, *place)]] = own
    known: dict[str, Any] = {"data_format": "RGBA", "origin": ORIGIN, "voxel_size": np.full(3, 0.5)}
    octree = SparseVoxelOctree((size,) * 3, np.array(tree, np.int32), data, **(known | fields))
    return octree.breadth_first()


def at(lattice: LatticeField, points: Any) -> Any:
    places = places_of(lattice, np.asarray(points, np.float64))
    return densities(nodes_of(lattice), places)


@pytest.fixture(scope="module")
def two() -> LatticeField:
    """Two voxels side by side along x, and one that is too thin to be seen."""
    held = {(4, 5, 6): [0.5, -1.0, 2.0, 30.0], (5, 5, 6): [0.5, -1.0, 2.0, 0.25], (9, 9, 9): [0, 0, 0, 1e-5]}
    return build_lattice(voxels(held), rounds=1)


def test_a_node_stands_at_each_voxels_centre_and_has_its_density(two: LatticeField) -> None:
    # Nodes 3 to 6 along x, 4 to 6 along y and 5 to 7 along z, one around the voxels on each side.
    assert two.shape == (4, 3, 3)
    assert_array_equal(two.box, ORIGIN + 0.5 * np.array([[3.5, 4.5, 5.5], [6.5, 6.5, 7.5]]))
    centres = ORIGIN + 0.5 * np.array([[4.5, 5.5, 6.5], [5.5, 5.5, 6.5]])
    assert_allclose(at(two, centres), [30, 0.25], rtol=1e-5)


def test_beside_a_voxel_hardly_anything_is_left_and_outside_nothing(two: LatticeField) -> None:
    beside = ORIGIN + 0.5 * np.array([[4.5, 5.5, 7.5], [3.5, 5.5, 6.5]])
    assert (at(two, beside) < np.array([0.4, 0.4])).all()  # softplus(-2) in half a unit is 0.25
    half_way = ORIGIN + 0.5 * np.array([4.5, 5.5, 7.0])
    raw = np.log(np.expm1(15.0))
    assert_allclose(at(two, [half_way]), np.logaddexp(0, (raw - 2) / 2) / 0.5, rtol=1e-4)


def test_colours_of_nodes_beside_are_their_neighbours(two: LatticeField) -> None:
    features = two.features[two.links.reshape(-1)].reshape(*two.shape, FEATURES)
    assert_allclose(features[0, 1, 1], features[1, 1, 1], atol=1e-6)
    assert_allclose(features[1, 2, 1], (features[1, 1, 1] + features[2, 1, 1]) / 2, atol=1e-6)


def test_what_has_no_neighbour_is_nothing_at_all() -> None:
    """Eleven voxels apart: between them raw values are 0, of an opacity that nobody looks at, and no node has a row."""
    far = voxels({(1, 1, 1): [0, 0, 0, 30.0], (12, 12, 12): [0, 0, 0, 30.0]})
    lattice = build_lattice(far, rounds=1)
    assert (lattice.shape, lattice.n) == ((14, 14, 14), 54)
    assert lattice.occupied is not None
    assert_array_equal(lattice.occupied, lattice.links >= 0)
    assert_array_equal(at(lattice, [ORIGIN + 3.5]), [0])
    opacity = 1 - np.exp(-np.logaddexp(0, lattice.activation.shift))
    assert_allclose(opacity, 1e-4, rtol=1e-3)
    assert 1 - (1 - opacity) ** 0.5 < lattice.least


def test_a_short_edge_is_made_two_thirds_of_the_longest() -> None:
    row = {(x, 7, 7): [0.0, 0.0, 0.0, 30.0] for x in range(2, 15)}
    assert build_lattice(voxels(row), rounds=1).shape == (15, 10, 10)


def test_colours_are_near_the_octrees_and_nearer_after_more_rounds() -> None:
    octree = build_octree(sample_n3tree(resolution=8))
    found = [measure_lattice(build_lattice(octree, rounds=rounds), octree) for rounds in (2, 80)]
    assert found[1] < 12 < found[0]


def test_the_same_seed_gives_the_same_lattice_and_another_does_not() -> None:
    octree = build_octree(n3tree(splits=[(0, (1, 0, 1))], data_format="SH4"))
    one, same, other = (build_lattice(octree, rounds=3, seed=seed) for seed in (1, 1, 2))
    for lattice in (same, other):
        assert_array_equal(one.links, lattice.links)
        assert_array_equal(one.density, lattice.density)
    assert isinstance(one.colour, MlpColour)
    assert isinstance(same.colour, MlpColour)
    assert isinstance(other.colour, MlpColour)
    assert_array_equal(one.colour.middle, same.colour.middle)
    assert_array_equal(one.features, same.features)
    assert (one.colour.middle != other.colour.middle).any()


def test_a_density_alone_is_grey() -> None:
    lattice = build_lattice(voxels({(1, 1, 1): [30.0]}, size=4, data_format=""), rounds=40)
    assert measure_lattice(lattice, voxels({(1, 1, 1): [0, 0, 0, 30.0]}, size=4)) < 6


def test_colours_without_harmonics_are_told_by_all_features() -> None:
    """Three numbers make three features; the others are the first again, and no grid of colours is all zeros."""
    held = {(x, 1, z): [x - 2.0, z - 1.5, 0.5 * x * z, 30.0] for x in range(1, 5) for z in range(1, 5)}
    octree = voxels(held, size=8)
    lattice = build_lattice(octree, rounds=60)
    assert_array_equal(lattice.features[:, 3:], lattice.features[:, :1].repeat(FEATURES - 3, axis=1))
    assert lattice.features.any(axis=0).all()
    assert measure_lattice(lattice, octree) < 12


def test_what_cannot_be_a_lattice_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(InvalidScene, match="is empty; allowed: a voxel that absorbs 2e-4 of the light"):
        build_lattice(voxels({(1, 1, 1): [0, 0, 0, 1e-5]}), rounds=1)
    with pytest.raises(InvalidScene, match=r"are 0.5 x 0.5 x 1; allowed: cubes"):
        build_lattice(voxels({(1, 1, 1): [0, 0, 0, 9.0]}, voxel_size=np.array([0.5, 0.5, 1])), rounds=1)
    with pytest.raises(InvalidScene, match=r"voxels of 0.5 at up to 1e\+08; allowed: a position that float32 resolves"):
        build_lattice(voxels({(1, 1, 1): [0, 0, 0, 9.0]}, origin=np.full(3, 1e8)), rounds=1)
    with pytest.raises(InvalidScene, match="rounds are 0; allowed: 1 or more"):
        build_lattice(voxels({(1, 1, 1): [0, 0, 0, 9.0]}), rounds=0)
    monkeypatch.setattr(stage, "MAX_EDGE", 2)
    with pytest.raises(InvalidScene, match="has 3 nodes along an axis; allowed: 2"):
        build_lattice(voxels({(1, 1, 1): [0, 0, 0, 9.0]}), rounds=1)
