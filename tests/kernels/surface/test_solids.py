"""Rays against boxes and rods: by hand, and against a search through all solids."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
from numpy.testing import assert_allclose

from nerfbake.kernels.surface import solids
from nerfbake.kernels.surface.solids import SolidGrid, Solids, grid_of, trace_solids

Array = npt.NDArray[np.float64]
UP = np.array([0.0, 0, 1])
# A box from (-1, -1, 0) to (1, 1, 1), and rods of radius 0.1: upright to 1.2 at x = 0, and along x at z = 2.
TABLE = Solids(
    np.array([[-1, -1, 0], [0, 1.5, 0], [-1, 0, 2]], np.float64),
    np.array([[1, 1, 1], [0, 1.5, 1.2], [1, 0, 2]], np.float64),
    np.array([0, 0.1, 0.1]),
    np.full((3, 3), 0.5),
    np.array([0, 0, 0.0]),
)


def traced(scene: Solids, eye: tuple[float, float, float], target: Array, lamp: Array = UP) -> npt.NDArray[np.float32]:
    """Trace rays from the eye towards places (m, 3)."""
    looks = target - np.array(eye)
    looks /= np.linalg.norm(looks, axis=1, keepdims=True)
    out = np.empty((len(looks), 5), np.float32)
    trace_solids(scene, grid_of(scene), lamp, np.array(eye, np.float64), looks, out)
    return out


@pytest.mark.parametrize(
    ("place", "depth"),
    [
        ((0.9, 0.9, 1), 4.0),  # the top of the box, 4 below
        ((0.9, 1.01, 0.5), None),  # beside it
        ((0, 1.5, 0), 3.8),  # the flat end of the upright rod
        ((0, 1.61, 0), None),  # beside it
        ((0.5, 0, 0), 2.9),  # the rod above the box
        ((0.5, 0.06, 0), 3 - 0.08),  # its side: sqrt(0.1^2 - 0.06^2) above its axis
        ((1.01, 0, 0), None),  # beyond its end, and beside the box
    ],
)
def test_what_a_ray_down_meets_by_hand(place: tuple[float, float, float], depth: float | None) -> None:
    (found,) = traced(TABLE, (place[0], place[1], 5), np.array([place]))
    assert_allclose(found[3:], [0, 0] if depth is None else [1, depth], rtol=1e-6)


def test_light_and_shadow_by_hand() -> None:
    top, shadowed, side = traced(TABLE, (3, -3, 5), np.array([[0.5, -0.5, 1], [0.5, 0.0, 1], [0.5, -1, 0.5]]))[:, :3]
    assert_allclose(top, 0.5, rtol=1e-6)  # faces the lamp
    assert_allclose(shadowed, 0.5 * 0.35, rtol=1e-6)  # below the rod
    assert_allclose(side, 0.5 * 0.35, rtol=1e-6)  # faces away from the lamp


def test_gloss_mirrors_the_lamp_where_its_ray_arrives() -> None:
    glossy = TABLE._replace(gloss=np.full(3, 0.4))
    lamp = np.array([0.6, 0, 0.8])
    # From (-2, -0.5, 5), the mirrored ray at (1, -0.5, 1) goes along (0.6, 0, 0.8), to the lamp.
    (found,) = traced(glossy, (-2, -0.5, 5), np.array([[1 - 1e-9, -0.5, 1]]), lamp)
    assert_allclose(found[:3], min(0.5 * (0.35 + 0.65 * 0.8) + 0.4 * (1 + 0.25 * 0.8), 1), rtol=1e-5)
    (away,) = traced(glossy, (2, -0.5, 5), np.array([[0.0, -0.5, 1]]), lamp)
    assert away[0] < found[0] - 0.3


def test_the_grid_changes_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    random = np.random.default_rng(3)
    first = random.uniform(-1, 1, (40, 3))
    second = first + random.uniform(0.01, 0.8, (40, 3))
    radius = np.where(np.arange(40) < 20, 0, random.uniform(0.01, 0.1, 40))
    scene = Solids(first, second, radius, random.uniform(0, 1, (40, 3)), np.full(40, 0.2))
    targets = random.uniform(-1.5, 1.5, (2000, 3))
    found = traced(scene, (0.3, 5, 2), targets)
    grid = grid_of(scene)
    everything = np.tile(np.arange(40), len(grid.begin) - 1)

    def listed(_: Solids) -> SolidGrid:
        return grid._replace(begin=40 * np.arange(len(grid.begin)), held=everything)

    monkeypatch.setitem(globals(), "grid_of", listed)
    assert 0.2 < found[:, 3].mean() < 0.9
    np.testing.assert_array_equal(traced(scene, (0.3, 5, 2), targets), found)


def test_every_cell_of_the_grid_lists_what_reaches_into_it() -> None:
    grid = grid_of(TABLE)
    edge = solids.CELLS
    for solid, place in ((0, (0.9, 0.9, 0.9)), (1, (0.05, 1.55, 0.6)), (2, (0.5, 0.05, 2.05))):
        x, y, z = ((np.array(place) - grid.low) / grid.size).astype(int)
        cell = (x * edge + y) * edge + z
        assert solid in grid.held[grid.begin[cell] : grid.begin[cell + 1]]
