"""The sphere unfolded: there and back, by hand, and across every edge."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from nerfbake.kernels.maths.elementary import fibonacci
from nerfbake.kernels.surface import octahedron


def test_the_axes_by_hand() -> None:
    # Up is the middle, down all four corners; x and z are the middles of the edges.
    axes = np.array([[0, 1, 0], [1, 0, 0], [-1, 0, 0], [0, 0, 1], [0, 0, -1], [0, -1, 0]])
    uv = octahedron.uv_of(axes)
    expected = np.array([[0.5, 0.5], [1, 0.5], [0, 0.5], [0.5, 1], [0.5, 0], [1, 1]])
    assert np.abs(uv - expected).max() < 1e-15
    np.testing.assert_allclose(octahedron.directions_of(uv), axes, atol=1e-15)


@given(arrays(np.float64, (50, 3), elements=st.floats(-1, 1)))
def test_there_and_back_anywhere_on_the_sphere(directions: np.ndarray) -> None:
    length = np.linalg.norm(directions, axis=1, keepdims=True)
    unit = (directions / np.where(length > 1e-6, length, 1))[length[:, 0] > 1e-6]
    assert np.abs(octahedron.directions_of(octahedron.uv_of(unit)) - unit).max(initial=0) < 1e-6


def test_there_and_back_everywhere_in_the_square() -> None:
    uv = np.random.default_rng(0).random((100_000, 2))
    assert np.abs(octahedron.uv_of(octahedron.directions_of(uv)) - uv).max() < 1e-6


def test_the_gutter_by_hand() -> None:
    framed = octahedron.with_gutter(np.arange(9).reshape(1, 3, 3), 1)[0]
    expected = [[8, 2, 1, 0, 6], [6, 0, 1, 2, 8], [3, 3, 4, 5, 5], [0, 6, 7, 8, 2], [2, 8, 7, 6, 0]]
    assert framed.tolist() == expected


@pytest.mark.parametrize("border", [1, 2])
def test_the_gutter_goes_on_where_the_sphere_does(border: int) -> None:
    # A map of the directions themselves: a texel of the gutter lies as near to the texels beside it as all others do.
    R = 32
    maps = octahedron.texel_directions(R).reshape(1, R, R, 3)
    framed = octahedron.with_gutter(maps, border)[0]
    inner = np.linalg.norm(np.diff(maps[0], axis=1), axis=-1).max()
    along_edge = np.s_[border : R + border]  # the texels of a corner of the gutter meet three others
    for step in (np.diff(framed[along_edge], axis=1), np.diff(framed[:, along_edge], axis=0)):
        assert np.linalg.norm(step, axis=-1).max() < 1.5 * inner


def test_a_smooth_function_is_looked_up_smoothly_everywhere() -> None:
    R = 64
    maps = (octahedron.texel_directions(R).reshape(1, R, R, 3) + 1).astype(np.float32)
    asked = np.concatenate(
        [fibonacci(5000), octahedron.directions_of(np.array([[0, 0.3], [1, 0.3], [0.3, 0], [0.3, 1]]))]
    )
    assert np.abs(octahedron.read_maps(maps, asked, "bilinear")[0] - 1 - asked).max() < 0.02  # a texel is 0.03 wide


def test_lookups_by_hand() -> None:
    # Straight down the z axis is u = 1/2 at the last row, between columns 1 and 2 of 4.
    maps = np.arange(16, dtype=np.uint8).reshape(1, 4, 4, 1)
    asked = np.array([[0.0, 0.0, 1.0]])
    assert octahedron.read_maps(maps, asked, "nearest").item() == 14
    assert octahedron.read_maps(maps, asked, "thesis").item() == 13  # int(1/2 * 3) = 1, int(1 * 3) = 3
    # Beyond the last row comes the last row mirrored: 14 and 13 below 13 and 14.
    assert octahedron.read_maps(maps, asked, "bilinear").item() == 13.5


@given(K=st.integers(1, 30), R=st.integers(2, 6), border=st.integers(0, 2))
def test_an_atlas_gives_back_its_maps(K: int, R: int, border: int) -> None:
    border = min(border, R // 2)
    maps = np.random.default_rng(K).integers(0, 256, (K, R, R, 3), np.uint8)
    image = octahedron.pack(maps, border)
    assert image.shape[1] == octahedron.tiles_per_row(K) * (R + 2 * border)
    np.testing.assert_array_equal(octahedron.unpack(image, K, R, border), maps)


def test_no_bilinear_lookup_mixes_two_maps() -> None:
    # As hardware filters: four texels of the whole atlas around the point, wherever in a tile it is.
    K, R, border = 7, 8, 1
    maps = np.repeat((np.arange(K, dtype=np.uint8) + 1)[:, None, None, None], R * R * 3, axis=1).reshape(K, R, R, 3)
    image = octahedron.pack(maps, border).astype(float)
    edges = np.linspace(0, 1, 41)
    u, v = (grid.ravel() for grid in np.meshgrid(edges, edges))
    per_row, edge = octahedron.tiles_per_row(K), R + 2 * border
    for tile in range(K):
        x = tile % per_row * edge + border + u * R - 0.5
        y = tile // per_row * edge + border + v * R - 0.5
        x0, y0 = np.floor(x).astype(int), np.floor(y).astype(int)
        for dx, dy in ((0, 0), (1, 0), (0, 1), (1, 1)):
            assert (image[y0 + dy, x0 + dx] == tile + 1).all()
