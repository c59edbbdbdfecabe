"""Splats: what their arrays must be, and which rows of a file are left out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from nerfbake import Splats
from nerfbake.errors import InvalidScene
from nerfbake.kernels.march.sh import sh_basis
from nerfbake.scene.splats import UPS, join_splats, splats_of_rows
from tests.support.splats import splats


def test_random_splats_are_sound_at_every_degree() -> None:
    for degree in range(5):
        scene = splats(3, degree=degree)
        assert (scene.n, scene.degree, scene.B) == (3, degree, (degree + 1) ** 2)
        assert not scene.problems()


def test_wrong_shapes_are_refused() -> None:
    scene = splats(3, degree=1)
    for change in (
        {"means": scene.means[:2]},
        {"scales": scene.scales.astype(np.float64)},
        {"quats": scene.quats[:, :3]},
        {"sh": scene.sh[:, :3]},
        {"sh": scene.sh[:, 0]},
    ):
        with pytest.raises(InvalidScene, match="allowed"):
            replace(scene, **change)


@pytest.mark.parametrize(
    ("name", "value", "told"),
    [
        ("means", np.nan, "means[1, 0] is nan"),
        ("scales", -1, "scales[1, 0] is -1"),
        ("quats", 2, "quats' lengths[1] is"),
        ("opacity", 1.5, "opacity[1] is 1.5"),
        ("sh", np.inf, "sh[1, 0, 0] is inf"),
    ],
)
def test_a_value_that_cannot_be_drawn_is_named(name: str, value: float, told: str) -> None:
    scene = splats(3)
    getattr(scene, name)[1] = value
    assert str(scene.problems()[0]).startswith(told)


def test_rows_that_cannot_be_drawn_are_left_out_and_counted() -> None:
    scene = splats(9)
    arrays = [
        np.array(array, np.float64) for array in (scene.means, scene.scales, scene.quats, scene.opacity, scene.sh)
    ]
    arrays[2] *= 3  # quaternions of any length
    arrays[0][1, 2], arrays[1][3, 0], arrays[2][5], arrays[4][7, 2, 1] = np.nan, 1e38, 0, np.inf
    found = splats_of_rows(*arrays)
    assert found.dropped == 4
    assert np.array_equal(found.means, scene.means[[0, 2, 4, 6, 8]])
    assert np.allclose(found.quats, scene.quats[[0, 2, 4, 6, 8]], atol=1e-7)
    assert str(found.problems()[0]).startswith("the file had 4 rows that cannot be drawn")
    arrays[3][8] = 2
    with pytest.raises(InvalidScene, match="have 5 rows of 9 that cannot be drawn; allowed: at most half"):
        splats_of_rows(*arrays)


def colours(scene: Splats, ways: np.ndarray) -> np.ndarray:
    """(n, directions, 3) SH at unit directions."""
    return np.asarray(np.einsum("db,nbc->ndc", sh_basis(ways, scene.B), scene.sh))


def covariances(scene: Splats) -> np.ndarray:
    w, x, y, z = scene.quats.T.astype(np.float64)
    turn = np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]).transpose(2, 0, 1)  # fmt: skip
    return np.asarray(np.einsum("nij,nj,nkj->nik", turn, scene.scales.astype(np.float64) ** 2, turn))


def require_moved(scene: Splats, moved: Splats, linear: np.ndarray, shift: np.ndarray) -> None:
    """That means, ellipsoids and colours have moved together, by float64 formulas."""
    scale = np.linalg.norm(linear[:, 0])
    np.testing.assert_allclose(moved.means, scene.means @ linear.T + shift, atol=1e-5)
    expected = linear @ covariances(scene) @ linear.T
    np.testing.assert_allclose(covariances(moved), expected, atol=1e-5 * np.abs(expected).max())
    ways = np.random.default_rng(3).normal(size=(50, 3))
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    np.testing.assert_allclose(colours(moved, ways @ linear.T / scale), colours(scene, ways), atol=1e-5)
    assert not moved.problems()


@pytest.mark.parametrize("degree", range(5))
@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("seed", range(4))
def test_a_transform_moves_means_ellipsoids_and_colours_together(degree: int, mirrored: bool, seed: int) -> None:
    random = np.random.default_rng(seed)
    turn = np.linalg.qr(random.normal(size=(3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn)) * (-1 if mirrored else 1)
    scene, shift = splats(20, degree=degree), random.normal(size=3)
    require_moved(scene, scene.transformed(np.column_stack([3 * turn, shift])), 3 * turn, shift)


def test_a_quarter_turn_about_z_by_hand() -> None:
    one = np.ones(1, np.float32)
    # f1^1 is -x: after the turn, what pointed along x points along y, which is f1^-1.
    sh = np.array([[[0] * 3, [0] * 3, [0] * 3, [1] * 3]], np.float32)
    turn = np.array([[1, 0, 0, 0]], np.float32)
    scene = Splats(np.array([[1, 2, 3]], np.float32), np.array([[1, 2, 3]], np.float32), turn, one, sh)
    found = scene.transformed(np.array([[0, -1, 0, 10], [1, 0, 0, 0], [0, 0, 1, 0]], np.float64))
    assert found.means.tolist() == [[8, 1, 3]]
    assert found.scales.tolist() == [[1, 2, 3]]
    np.testing.assert_allclose(found.quats, [[np.sqrt(0.5), 0, 0, np.sqrt(0.5)]], rtol=1e-6)
    assert found.sh[0, :, 0].tolist() == [0, 1, 0, 0]


def test_flipping_is_half_a_turn_about_x_exact_to_the_bit() -> None:
    scene = splats(50, degree=4)
    require_moved(scene, scene.flipped(), np.diag([1.0, -1.0, -1.0]), np.zeros(3))
    again = scene.flipped().flipped()
    for name in ("means", "scales", "quats", "opacity", "sh"):
        assert np.array_equal(getattr(again, name), getattr(scene, name))


@pytest.mark.parametrize("up", UPS)
def test_any_axis_becomes_minus_y(up: str) -> None:
    scene = splats(5, degree=4)
    scene.means[0] = np.eye(3)["xyz".index(up[-1])] * (-1 if up[0] == "-" else 1)
    found = scene.with_up(up)  # type: ignore[arg-type]
    assert found.means[0].tolist() == [0, -1, 0]
    linear = np.linalg.lstsq(scene.means, found.means, rcond=None)[0].T
    assert np.isclose(np.linalg.det(linear), 1)
    require_moved(scene, found, np.rint(linear), np.zeros(3))


def test_a_transform_that_shears_is_refused() -> None:
    for linear in (np.diag([1.0, 1.0, 1.1]), np.array([[1, 0.1, 0], [0, 1, 0], [0, 0, 1]]), np.zeros((3, 3))):
        with pytest.raises(InvalidScene, match="allowed: a rotation, a reflection, and one scale"):
            splats(3).transformed(np.column_stack([linear, np.zeros(3)]))


def test_splats_of_several_parts_are_joined() -> None:
    first, second = splats(3, degree=1), replace(splats(2, degree=2), dropped=1, notes=("a", "b"))
    whole = join_splats([first, second, replace(first, notes=("b",))])
    assert (whole.n, whole.degree, whole.dropped, whole.notes) == (8, 2, 1, ("a", "b"))
    assert np.array_equal(whole.means[3:5], second.means)
    assert np.array_equal(whole.sh[:3, :4], first.sh)
    assert not whole.sh[:3, 4:].any()
    assert np.array_equal(whole.with_degree(1).sh[5:], first.sh)
