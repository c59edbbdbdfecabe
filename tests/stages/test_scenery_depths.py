"""Depths that neighbouring photographs show, and what they say about cells."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from nerfbake import Camera, Cameras, Views, fit_field, memory_limit
from nerfbake.errors import MemoryLimit
from nerfbake.kernels.arrays import Floats, Singles
from nerfbake.kernels.fit.bricks import values_by_cell
from nerfbake.scene.lens import Lens
from nerfbake.scene.schedule import parse_schedule
from nerfbake.stages._bricks import BrickCells, cell_places, cells_of_solid
from nerfbake.stages._depth_map import DepthMap
from nerfbake.stages._fit_state import FitState
from nerfbake.stages._scenery import follow_depths, start_scenery
from nerfbake.stages._scenery_depths import Depths, find_depths, vote

HEIGHT, EDGE = 5.0, 64
BOX = np.array([[-4.0, -4, -4], [4, 4, 4]])


def ground(x: Floats, y: Floats, *, plain: bool = False) -> Floats:
    """A pattern of waves of many directions and lengths, 0 to 255."""
    waves = np.random.default_rng(0).normal(0, 5, (40, 2))
    grey = sum(np.sin(x * a + y * b + i) for i, (a, b) in enumerate(waves.tolist()))
    return np.asarray(128 + (0 if plain else 16) * np.clip(grey, -7, 7), np.float64)


def above(lens: Lens | None = None, *, edge: int = EDGE, plain: bool = False, block: float = 0.0) -> Views:
    """Photographs of the ground z = 0 from 4 x 2 places that are 0.8 apart, HEIGHT above it.

    block: the height of a block that fills the ground where x > 0.
    """
    cameras, pictures = [], []
    for place in range(8):
        pose = np.eye(4)
        pose[:3, 3] = 0.8 * (place % 4) - 1.2, 0.8 * (place // 4) - 0.4, HEIGHT
        camera = Camera(edge, edge, float(edge), pose, str(place), lens=lens)
        eye, looks = camera.rays()
        low, high = (eye - looks / looks[:, 2:] * (HEIGHT - z) for z in (0.0, block))
        places = np.where(high[:, :1] > 0, high, low)
        grey = ground(places[:, 0], places[:, 1], plain=plain).reshape(edge, edge, 1).astype(np.uint8)
        pictures.append(np.concatenate([grey, grey, grey, np.full_like(grey, 255)], axis=2))
        cameras.append(camera)
    return Views(Cameras(tuple(cameras)), tuple(pictures), (1.0, 1.0, 1.0), False, scenery=True)


@pytest.fixture(scope="module")
def depths() -> Depths:
    return find_depths(above(), HEIGHT)


@pytest.fixture(scope="module")
def maps(depths: Depths) -> list[DepthMap]:
    return [*depths.maps.values()]


def test_the_depth_of_a_plane_is_known(maps: list[DepthMap]) -> None:
    assert len(maps) == 8
    for found in maps:
        assert found.known.mean() > 0.7
        assert np.quantile(np.abs(HEIGHT * found.inverse[found.known] - 1), 0.98) < 0.02
        assert np.median(np.abs(HEIGHT * found.inverse - 1)) < 0.01


def test_a_lens_changes_no_depth() -> None:
    bent = find_depths(above(Lens("polynomial", (-0.2,))), HEIGHT).maps.values()
    assert len(bent) == 8
    for found in bent:
        assert not found.camera.bends
        assert found.known.mean() > 0.7
        assert np.median(np.abs(HEIGHT * found.inverse[found.known] - 1)) < 0.02


@pytest.mark.parametrize("views", [above(plain=True), above(edge=32)])
def test_no_depth_is_known_without_texture_or_in_small_pictures(views: Views) -> None:
    maps, overlap = find_depths(views, HEIGHT)
    assert not maps
    assert overlap.agreement is None


def test_pictures_agree_only_with_the_right_poses(depths: Depths) -> None:
    views = above()
    swapped = replace(views, pictures=[views.pictures[number] for number in np.random.default_rng(0).permutation(8)])
    wrong = find_depths(swapped, HEIGHT).overlap.agreement
    assert depths.overlap.agreement is not None
    assert wrong is not None
    assert depths.overlap.agreement > 0.8
    assert wrong < 0.12
    assert find_depths(views.take(range(4)), HEIGHT).overlap.agreement is None  # four are too few to say


def test_a_picture_of_another_place_is_alone(depths: Depths) -> None:
    assert depths.overlap.alone == ()
    views = above()
    pictures = list(views.pictures)
    pictures[2] = np.ascontiguousarray(pictures[2][:, ::-1])
    assert find_depths(replace(views, pictures=pictures), HEIGHT).overlap.alone == (2,)


def test_depths_count_as_memory() -> None:
    with memory_limit(28 * 8 * EDGE**2 - 1), pytest.raises(MemoryLimit, match="depths of 8 pictures"):
        find_depths(above(), HEIGHT)


def test_unknown_depths_are_those_of_the_farther_side() -> None:
    for found in find_depths(above(block=2.0), HEIGHT).maps.values():
        known = found.inverse[found.known]
        assert ((np.abs(known * 5 - 1) < 0.04) | (np.abs(known * 3 - 1) < 0.04)).mean() > 0.9
        assert (found.inverse[~found.known] < 1 / 3).mean() > 0.5


@pytest.mark.parametrize(("z", "empty", "surface"), [(2.0, True, False), (0.0, False, True), (-2.0, False, False)])
def test_cells_before_the_ground_are_empty(
    maps: list[DepthMap], z: float, empty: bool, surface: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("nerfbake.stages._scenery_depths._CELLS", 20)
    centre = np.random.default_rng(1).uniform(-1, 1, (50, 3)) * (1, 1, 0) + (0, 0, z)
    votes = vote(maps, centre, np.full(50, 0.2))
    assert (votes.empty == empty).all()
    assert (votes.surface == surface).all()


def test_cells_that_no_view_shows_have_no_votes(maps: list[DepthMap]) -> None:
    votes = vote(maps, np.array([[0.0, 0, 9], [50, 0, 0]]), np.full(2, 0.2))
    assert not votes.empty.any()
    assert not votes.surface.any()


@pytest.mark.slow
def test_a_fit_starts_with_dense_cells_on_the_ground() -> None:
    field, plain = (start_scenery(views, BOX, 32, 1).cells for views in (above(), above(plain=True)))
    assert 0 < field.n < plain.n
    dense = [np.isclose(cells.bricks.values, 0.3).sum() for cells in (field, plain)]
    assert dense[0] > 100
    assert dense[1] == 0


def test_finer_cells_follow_the_depths(maps: list[DepthMap]) -> None:
    cells = cells_of_solid(np.ones((32, 32, 32), bool), BOX, 1, 0.01)
    followed = follow_depths(cells, maps, BOX)
    _, corner = cell_places(followed.bricks)
    z, density = corner[:, 2] / 4 - 3.875, values_of(followed)[:, -1]
    x, y = corner[:, 0] / 4 - 3.875, corner[:, 1] / 4 - 3.875
    seen = (np.abs(x) < 1) & (np.abs(y) < 1)
    assert not (seen & (z > 1)).any()
    assert (density[seen & (np.abs(z) < 0.2)] == np.float32(0.3)).all()
    assert (density[z < -1] == np.float32(0.01)).all()
    assert np.count_nonzero(z < -1) == 32 * 32 * 12


def test_following_depths_needs_the_memory_that_it_asks_for(
    maps: list[DepthMap], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("NUMBA_NUM_THREADS", "1")
    solid = np.zeros((64, 64, 64), bool)
    solid[:, :, :24] = True  # below the ground, so that no cell is dropped
    cells = cells_of_solid(solid, BOX, 1, 0.01)
    tracemalloc.start()
    assert follow_depths(cells, maps, BOX) is cells
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    with memory_limit(int(1.1 * peak)):
        follow_depths(cells, maps, BOX)
    with memory_limit(int(0.9 * peak)), pytest.raises(MemoryLimit, match="places of 98,304 cells"):
        follow_depths(cells, maps, BOX)


@pytest.mark.slow
def test_a_fit_with_depths_resumes_with_the_same_bytes() -> None:
    schedule = parse_schedule("cells=32,scale=4/cells=64,scale=4")
    arrays = [
        {name: array.copy() for name, array in state.arrays().items()}
        for state in fit_field(above(), schedule=schedule, basis="SH1", box=BOX)
        if state.view == 0
    ]
    *_, resumed = fit_field(above(), schedule=schedule, start=FitState.of_arrays(arrays[0]))
    for name, array in arrays[-1].items():
        assert_array_equal(resumed.arrays()[name], array, err_msg=name)


def values_of(cells: BrickCells) -> Singles:
    values = np.empty((cells.n, 4), np.float32)
    values_by_cell(cells.bricks.values, cells.bricks.first, values)
    return values
