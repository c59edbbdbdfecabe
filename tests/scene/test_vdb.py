from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_array_equal

from nerfbake import build_field, build_octree_from_density, orbit_cameras, render_field, summarise_scene
from nerfbake.errors import InvalidScene
from nerfbake.formats.volume import nanovdb as vdb_nanovdb
from nerfbake.formats.volume import npz as vdb_npz
from nerfbake.formats.volume import openvdb as vdb_openvdb
from nerfbake.memory import memory_limit
from nerfbake.scene.vdb import IndexGrid, VdbTree
from nerfbake.scene.vdb_topology import VdbTiles, VdbTopology, topology_of
from nerfbake.scene.volume import Volume
from tests.support.vdb_readers import SCENES, index, transform, tree

coordinates = st.integers(-(2**20), 2**20) | st.integers(-9, 9)


def test_a_tree_by_hand() -> None:
    # Two voxels of one leaf, one of the next leaf on z, one of the next upper node on x.
    topology, order = topology_of(np.array([[4096, 0, 0], [0, 0, 8], [0, 1, 0], [0, 0, 7]]))
    assert_array_equal(order, [3, 2, 1, 0])
    assert topology.node_counts == (2, 2, 3)
    assert_array_equal(topology.root_origin, [[0, 0, 0], [4096, 0, 0]])
    assert_array_equal(topology.leaf_origin, [[0, 0, 0], [0, 0, 8], [4096, 0, 0]])
    assert topology.leaf_mask[0, 0] == 1 << 7 | 1 << 8
    assert topology.lower_mask[0, 0] == 0b11
    assert_array_equal(topology.first, [0, 2, 3])


@given(st.sets(st.tuples(coordinates, coordinates, coordinates), max_size=60))
def test_the_voxels_are_those_that_were_given(voxels: set[tuple[int, int, int]]) -> None:
    coords = np.array(list(voxels), np.int64).reshape(-1, 3)
    topology, order = topology_of(coords)
    assert topology.structure_problems() == []
    assert_array_equal(topology.coords, coords[order])
    if voxels:
        assert topology.box is not None
        assert_array_equal(topology.box, [coords.min(axis=0), coords.max(axis=0)])


def test_a_voxel_may_not_come_twice() -> None:
    with pytest.raises(InvalidScene, match=r"voxel \(1, 2, 3\) occurs twice; allowed: each voxel once"):
        topology_of(np.array([[1, 2, 3], [0, 0, 0], [1, 2, 3]]))


def test_beyond_32_bits_there_are_no_voxels() -> None:
    with pytest.raises(InvalidScene, match="lies at 2147483648; allowed: coordinates of 32 bits"):
        topology_of(np.array([[2**31, 0, 0]]))


def test_masks_that_disagree_are_found() -> None:
    topology = tree(SCENES["a cloud"]).topology
    for name in ("upper_mask", "lower_mask"):
        mask = getattr(topology, name).copy()
        mask[0, 0] ^= np.uint64(1)
        assert replace(topology, **{name: mask}).structure_problems()[0].place == name
    doubled = replace(topology, root_origin=topology.root_origin[::-1].copy())
    assert "out of order" in str(doubled.structure_problems()[0])
    assert "multiples of 4096" in str(replace(topology, root_origin=topology.root_origin + 1).structure_problems()[0])


def test_values_that_are_not_the_voxels_are_found() -> None:
    good = tree(SCENES["one voxel"])
    two = VdbTree("density", good.topology, np.ones((2, 1), np.float32), good.background)
    with pytest.raises(InvalidScene, match="grid 'density' has 2 values; allowed: 1, one per voxel"):
        Volume((two,), transform()).require_sound()
    nan = VdbTree("density", good.topology, np.full((1, 1), np.nan, np.float32), good.background)
    assert str(Volume((nan,), transform()).problems()[0]) == "density[0, 0] is nan; allowed: a finite number"
    flat = Volume((good,), np.zeros((3, 4)))
    assert "cannot be inverted" in str(flat.problems()[0])


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: tree([[0, 0, 0]], channels=2), "(m, 1 or 3) float16 or float32"),
        (lambda: tree([[0, 0, 0]], dtype=np.float64), "dtype float64"),
        (lambda: IndexGrid("index", index([]).topology, np.zeros((0, 4), np.float32)), "has shape (0, 4)"),
        (lambda: Volume((), transform()), "has no grids"),
        (lambda: Volume((tree([]),), np.zeros((4, 4))), "transform has shape (4, 4)"),
        (lambda: replace(tree([]).topology, leaf_mask=np.zeros((1, 8), np.int64)), "dtype int64"),
    ],
)
def test_shapes_are_held_to(make: object, said: str) -> None:
    assert callable(make)
    with pytest.raises(InvalidScene) as error:
        make()
    assert said in str(error.value)


def test_an_index_grid_has_the_background_in_row_0() -> None:
    grid = index([[0, 0, 0], [5, 5, 5]])
    assert_array_equal(grid.values, grid.table[1:])
    assert_array_equal(grid.background, 0)


# -- tiles -----------------------------------------------------------------------------------------------------
def with_tiles(coords: npt.ArrayLike = ((3, 5, 6),)) -> VdbTopology:
    """Voxels, a tile of 8^3 at (8, 0, 0), one of 128^3 at (0, 128, 0), one of 4096^3 at (0, 0, -4096)."""
    topology = tree(coords).topology
    lower, upper = np.zeros_like(topology.lower_mask), np.zeros_like(topology.upper_mask)
    lower[0, 256 >> 6], upper[0, 32 >> 6] = 1, 1 << 32  # slots 1 << 8 and 1 << 5
    return replace(topology, tiles=VdbTiles(lower, upper, np.array([[0, 0, -4096]], np.int32)))


def test_tiles_by_hand() -> None:
    made = with_tiles()
    assert made.structure_problems() == []
    assert (made.m, made.tile_counts, made.count) == (1, (1, 1, 1), 4)
    assert made.voxel_count == 1 + 8**3 + 128**3 + 4096**3
    assert [(low.tolist(), edge) for low, edge in made.tile_cubes] == [
        ([[8, 0, 0]], 8),
        ([[0, 128, 0]], 128),
        ([[0, 0, -4096]], 4096),
    ]
    assert made.box is not None
    assert_array_equal(made.box, [[0, 0, -4096], [4095, 4095, 127]])
    places = [[3, 5, 6], [3, 5, 7], [8, 0, 0], [15, 7, 7], [16, 0, 0], [0, 128, 0], [127, 255, 127], [0, 0, -1]]
    assert_array_equal(made.rows_at(np.array(places)), [0, -1, 1, 1, -1, 2, 2, 3])
    assert_array_equal(made.rows_at(np.array([[1 << 40, 0, 0], [-(1 << 33), 0, -1]])), [-1, -1])


def test_some_of_the_values_alone() -> None:
    made = with_tiles()
    for kept in range(4):
        alone = made.only(np.arange(4) == kept)
        assert alone.node_counts == made.node_counts
        assert (alone.count, alone.structure_problems()) == (1, [])
        assert alone.voxel_count == [1, 8**3, 128**3, 4096**3][kept]
    assert made.only(np.ones(4, bool)).same_as(made)
    assert not made.only(np.arange(4) < 3).same_as(made)


def test_what_is_said_of_tiles_is_held_to() -> None:
    made = with_tiles()
    assert made.tiles is not None
    child = replace(made.tiles, lower_mask=made.tiles.lower_mask | made.lower_mask)
    assert "slots that are child and tile at once" in str(replace(made, tiles=child).structure_problems()[0])
    for origin in ([[0, 0, 0]], [[0, 0, 1]], [[4096, 0, 0], [4096, 0, 0]]):
        wrong = replace(made.tiles, root_origin=np.array(origin, np.int32))
        assert "root tiles overlap or are misaligned" in str(replace(made, tiles=wrong).structure_problems()[0])
    with pytest.raises(InvalidScene, match=r"tiles\.upper_mask has shape \(2, 512\)"):
        replace(made, tiles=replace(made.tiles, upper_mask=np.zeros((2, 512), np.uint64)))
    table = IndexGrid("index", made, np.ones((5, 1), np.float32))
    assert str(table.structure_problems()[0]) == (
        "grid 'index' is an index grid with tiles; allowed: an index grid without tiles"
    )
    nan = VdbTree("density", made, np.array([[1], [np.nan], [1], [np.inf]], np.float32), np.zeros(1, np.float32))
    assert str(nan.value_problems()[0]) == "density[1, 0] is nan; allowed: a finite number (and 1 more)"


def test_a_small_file_of_large_tiles_stays_small() -> None:
    """Read, told of, shown and converted in a few MB, whatever it would be as voxels."""
    values = np.full((4, 1), 0.01, np.float32)
    made = Volume((VdbTree("density", with_tiles(), values, np.zeros(1, np.float32)),), transform())
    with memory_limit(40 << 20):
        for module in (vdb_openvdb, vdb_nanovdb, vdb_npz):
            back = module.decode(memoryview(b"".join(module.encode(made))))
            assert summarise_scene(back)["grids"]["density"]["active_voxels"] == 1 + 8**3 + 128**3 + 4096**3
            assert back.problems() == []
        with pytest.raises(InvalidScene, match="reaches over 4,096x4,096x4,224 voxels; allowed: 4,096 along an axis"):
            build_octree_from_density(back)
        field = build_field(back)
        assert render_field(field, orbit_cameras(field, frames=1, width=4, height=4).cameras[0]).alpha.max() > 0.9


def test_colours_finer_than_a_tile_are_refused() -> None:
    density = VdbTree("density", with_tiles(), np.ones((4, 1), np.float32), np.zeros(1, np.float32))
    colour = tree([[3, 5, 6], [9, 1, 1]], channels=3, name="Cd")
    with pytest.raises(InvalidScene, match=r"grid 'Cd' has voxels where the density has one tile, at \(8, 0, 0\)"):
        build_field(Volume((density, colour), transform()))
    with pytest.raises(InvalidScene, match="grid 'Cd' has another transform than the density"):
        build_field(Volume((density, replace(colour, place=np.eye(3, 4))), transform()))
