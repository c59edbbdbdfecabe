"""Charts: every triangle has a place of its own, far enough from others for bilinear lookups."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from trimesh.graph import connected_component_labels

from nerfbake import Mesh, memory_limit, unwrap_surface
from nerfbake.errors import InvalidScene, MemoryLimit
from nerfbake.kernels.arrays import Floats, Ints
from nerfbake.kernels.surface.charts import neighbours, overlap
from tests.support.meshes import cube, mesh, sphere

FINER = 4  # points along a texel at which triangles are counted


def corners_of(unwrapped: Mesh) -> Floats:
    return unwrapped.require_unwrapped()[unwrapped.faces].astype(np.float64)


def charts_of(unwrapped: Mesh) -> Ints:
    """(t,) the chart of each triangle: triangles that share vertices are in one."""
    a, b, c = unwrapped.faces.astype(np.int64).T
    edges = np.stack([np.concatenate([a, b]), np.concatenate([b, c])], axis=1)
    labels: Ints = connected_component_labels(edges, len(unwrapped.positions))  # type: ignore[no-untyped-call]
    return np.asarray(labels[a], np.int64)


def most_at_a_point(corners: Floats, edge: int) -> int:
    """The largest number of triangles that have a point of a fine grid well inside."""
    count = np.zeros((edge, edge), int)
    for a, b, c in corners * edge:
        low, high = np.floor(np.minimum(np.minimum(a, b), c)).astype(int), np.ceil(np.maximum(np.maximum(a, b), c))
        y, x = np.mgrid[low[1] : int(high[1]) + 1, low[0] : int(high[0]) + 1] + 0.5
        inside = np.ones(x.shape, bool)
        turn = np.sign((b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]))
        for p, q in pairwise([a, b, c, a]):
            inside &= turn * ((q[0] - p[0]) * (y - p[1]) - (q[1] - p[1]) * (x - p[0])) > 1e-3 * np.hypot(*(q - p))
        count[y[inside].astype(int), x[inside].astype(int)] += 1
    return int(count.max())


def assert_apart(unwrapped: Mesh, edge: int) -> None:
    """No triangle covers another one, and lookups in two charts read different texels, with one more between them."""
    corners, chart = corners_of(unwrapped), charts_of(unwrapped)
    assert most_at_a_point(corners, FINER * edge) == 1
    owner = np.full((edge + 2, edge + 2), -1)
    sides = np.linspace(0, 1, 33)
    for k in range(3):  # the outlines of triangles are enough: what is inside reads no other texels than they enclose
        along = corners[:, k, None] + sides[:, None] * (corners[:, (k + 1) % 3] - corners[:, k])[:, None]
        texel = np.floor(along * edge - 0.5).astype(int)
        assert texel.min() >= 0
        assert texel.max() <= edge - 2
        who = np.broadcast_to(chart[:, None], texel.shape[:2])
        for dy in range(3):  # two texels are read, and one more is the gutter
            for dx in range(3):
                here = owner[texel[..., 1] + dy, texel[..., 0] + dx]
                if dx < 2 and dy < 2:
                    assert ((here == -1) | (here == who)).all()
                owner[texel[..., 1] + dy, texel[..., 0] + dx] = who


def assert_same_triangles(a: Mesh, b: Mesh) -> None:
    np.testing.assert_array_equal(a.positions[a.faces], b.positions[b.faces])


def test_a_cube_by_hand() -> None:
    unwrapped = unwrap_surface(cube(), edge=64)
    assert_same_triangles(unwrapped, cube())
    chart = charts_of(unwrapped)
    assert len(np.unique(chart)) == 6
    assert len(unwrapped.positions) == 24
    # The two triangles of a side are in one chart; all have the same size, and their angles are right.
    np.testing.assert_array_equal(chart[:6], chart[6:])
    a, b, c = np.moveaxis(corners_of(unwrapped), 1, 0)
    double = np.cross(np.pad(b - a, ((0, 0), (0, 1))), np.pad(c - a, ((0, 0), (0, 1))))[:, 2]
    np.testing.assert_allclose(double, double[0], rtol=1e-4)
    assert double[0] > 0.5 / 9
    lengths = np.sort([np.hypot(*(b - a).T), np.hypot(*(c - b).T), np.hypot(*(a - c).T)], axis=0)
    np.testing.assert_allclose(lengths[2] / lengths[0], np.sqrt(2), rtol=1e-4)
    assert_apart(unwrapped, 64)


def test_a_sphere_keeps_its_scale_and_fills_half_of_the_texture() -> None:
    ball = sphere(48, 96)
    unwrapped = unwrap_surface(ball, edge=512)
    assert_same_triangles(unwrapped, ball)
    assert_apart(unwrapped, 512)
    a, b, c = np.moveaxis(corners_of(unwrapped), 1, 0)
    flat = np.cross(np.pad(b - a, ((0, 0), (0, 1))), np.pad(c - a, ((0, 0), (0, 1))))[:, 2]
    assert flat.min() > 0  # none is mirrored
    assert 0.4 < flat.sum() / 2 < 1
    p, q, r = np.moveaxis(ball.positions[ball.faces], 1, 0)
    shares = flat / np.linalg.norm(np.cross(q - p, r - p), axis=1)
    assert np.quantile(shares, 0.95) / np.quantile(shares, 0.05) < 1.6


@given(st.integers(0, 10_000), st.sampled_from([0.0, 0.05, 0.3]), st.booleans())
def test_rough_and_torn_surfaces_stay_apart(seed: int, noise: float, torn: bool) -> None:
    random = np.random.default_rng(seed)
    ball = sphere(8, 12)
    moved = replace(ball, positions=ball.positions + random.normal(0, noise, ball.positions.shape).astype(np.float32))
    if torn:
        moved = replace(moved, faces=moved.faces[random.random(len(moved.faces)) < 0.7])
    unwrapped = unwrap_surface(moved, edge=256)
    assert_same_triangles(unwrapped, moved)
    assert_apart(unwrapped, 256)


def test_a_soup_of_crossing_triangles_has_a_place_for_each() -> None:
    random = np.random.default_rng(3)
    soup = mesh(random.normal(size=(60, 3)), random.integers(0, 60, (400, 3)))
    unwrapped = unwrap_surface(soup, edge=512)
    assert_same_triangles(unwrapped, soup)
    assert_apart(unwrapped, 512)


def test_a_spiral_does_not_cover_itself() -> None:
    # A flat strip that winds around an axis twice: its projection along z covers every place twice.
    turn = np.linspace(0, 4 * np.pi, 17)
    rims = [np.stack([r * np.cos(turn), r * np.sin(turn), 0.02 * turn], axis=1) for r in (0.5, 1)]
    i = np.arange(16)
    strip = mesh(
        np.concatenate(rims), np.concatenate([np.stack([i, i + 17, i + 18], 1), np.stack([i, i + 18, i + 1], 1)])
    )
    unwrapped = unwrap_surface(strip, edge=256)
    assert len(np.unique(charts_of(unwrapped))) > 1
    assert_apart(unwrapped, 256)


def test_triangles_without_area_stay() -> None:
    flat = mesh([[0, 0, 0], [1, 0, 0], [0, 1, 0], [2, 0, 0]], [[0, 1, 2], [0, 1, 3], [1, 1, 1]])
    unwrapped = unwrap_surface(flat, edge=32)
    assert_same_triangles(unwrapped, flat)
    assert np.isfinite(unwrapped.require_uvs()).all()
    assert_same_triangles(
        unwrap_surface(replace(flat, faces=flat.faces[1:]), edge=32), replace(flat, faces=flat.faces[1:])
    )


def test_seams_of_the_input_do_not_matter_and_colours_stay() -> None:
    colours = np.random.default_rng(0).random((8, 3)).astype(np.float32)
    whole = cube(colours=colours)
    torn = Mesh(whole.positions[whole.faces.reshape(-1)], None, np.arange(36, dtype=np.uint32).reshape(12, 3))
    together, apart = unwrap_surface(whole, edge=64), unwrap_surface(torn, edge=64)
    np.testing.assert_array_equal(corners_of(together), corners_of(apart))
    assert together.colours is not None
    np.testing.assert_array_equal(together.colours[together.faces], colours[whole.faces])


def test_neighbours_by_hand() -> None:
    # The edge 1-2 belongs to two triangles, 1-3 to three; the last two wind in opposite ways along 3-4.
    faces = np.array([[0, 1, 2], [2, 1, 3], [3, 1, 4], [3, 4, 5], [1, 3, 6], [4, 3, 7], [3, 4, 8]], np.uint32)
    np.testing.assert_array_equal(neighbours(faces[:2]), [[-1, 1, -1], [0, -1, -1]])
    np.testing.assert_array_equal(neighbours(faces[:3]), [[-1, 1, -1], [0, 2, -1], [1, -1, -1]])
    np.testing.assert_array_equal(neighbours(faces[2:4]), [[-1, -1, 1], [0, -1, -1]])
    np.testing.assert_array_equal(neighbours(faces[[1, 4]]), -1)
    fan = np.array([[0, 1, 2], [1, 0, 3], [0, 1, 4]], np.uint32)
    np.testing.assert_array_equal(neighbours(fan), -1)


def test_overlap_by_hand() -> None:
    a = np.array([[0.0, 0], [1, 0], [0, 1]])
    assert overlap(a, a)
    assert overlap(a, a * 0.1 + 0.2)
    assert not overlap(a, a[[1, 0, 2]] * [1, -1])  # shares an edge
    assert not overlap(a, a + np.array([1, 0]))  # shares a corner
    assert not overlap(a, np.array([[0.0, 0], [1, 1], [2, 2]]))  # has no area
    assert not overlap(a, np.array([[1.0, 1], [0.6, 0.6], [1, 0.5]]))  # their boxes overlap alone


def test_what_does_not_fit_is_refused() -> None:
    random = np.random.default_rng(3)
    soup = mesh(random.normal(size=(60, 3)), random.integers(0, 60, (400, 3)))
    with pytest.raises(InvalidScene, match=r"the texture's edge is 16 texels, too few for \d+ charts"):
        unwrap_surface(soup, edge=16)
    for edge in (15, 8193):
        with pytest.raises(InvalidScene, match=f"the texture's edge is {edge}; allowed: 16 to 8,192 texels"):
            unwrap_surface(cube(), edge=edge)
    with memory_limit(100_000), pytest.raises(MemoryLimit, match="the charts of the mesh"):
        unwrap_surface(cube(), edge=1024)
