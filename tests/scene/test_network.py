from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose

from nerfbake.errors import InvalidScene
from nerfbake.kernels.march.sh import sh_basis
from nerfbake.kernels.maths.elementary import fibonacci
from nerfbake.scene.lattice_field import Activation
from nerfbake.scene.network import BasisColour, Frequencies, HashGrid, HeadColour, Mlp, Network


def mlp(*weights: object, biases: tuple[object, ...] = ()) -> Mlp:
    made = tuple(np.array(weight, np.float32) for weight in weights)
    given = biases or tuple(np.zeros(len(weight)) for weight in made)
    return Mlp(made, tuple(np.array(bias, np.float32) for bias in given))


def test_frequencies_by_hand() -> None:
    code = Frequencies(np.array([1.0, 2.0]))(np.array([[0.5, 0.25, -1.0]]))
    angles = np.array([0.5, 1.0, 0.25, 0.5, -1.0, -2.0])  # x times each frequency, then y, then z
    assert_allclose(code[:, 0], [0.5, 0.25, -1.0, *np.sin(angles), *np.cos(angles)], atol=1e-7)


def test_rounded_cosines_are_sines_of_angles_in_float32() -> None:
    x = np.linspace(3, 4, 50).astype(np.float32)
    points = np.stack([x, x, x], axis=1)
    code = Frequencies(np.array([512.0]), rounded=True)(points)
    angles = x * np.float32(512)
    assert_allclose(code[3], np.sin(angles.astype(float)), atol=1e-7)
    assert_allclose(code[6], np.sin((angles + np.float32(np.pi / 2)).astype(float)), atol=1e-7)
    assert np.abs(code[6] - np.cos(angles.astype(float))).max() > 2e-6
    scaled = Frequencies(np.array([3.3]), rounded=True, unit=0.7)(points)[3]
    assert_allclose(scaled, np.sin((np.float32(0.7) * x * np.float32(3.3)).astype(float)), atol=1e-7)


def test_shifted_polynomials_are_those_of_half_of_d_plus_1() -> None:
    colour = HeadColour(mlp(np.zeros((3, 17))), "shifted")
    x, y, z = (d + 1) / 2 if (d := np.array([0.48, -0.6, 0.64])).any() else d
    code = colour.encoded(np.array([[0.48, -0.6, 0.64]]))[:, 0]
    assert_allclose(code[[1, 2, 3]], 0.4886025119 * np.array([y, z, x]), rtol=1e-6)
    assert_allclose(code[6], 0.9461746958 * z * z - 0.3153915653, rtol=1e-5)
    assert_allclose(code[12], 0.3731763326 * z * (5 * z * z - 3), rtol=1e-5)
    assert_allclose(code[15], 0.5900435899 * x * (x * x - 3 * y * y), rtol=1e-5)


def test_a_head_takes_features_before_the_direction() -> None:
    weights = np.zeros((3, 2 + 3))
    weights[0, 0], weights[1, 1], weights[2, 4] = 1, 1, 1  # feature 0, feature 1, z
    colour = HeadColour(mlp(weights), Frequencies(np.zeros(0)))
    logits = colour.logits(np.array([[5], [7]], np.float32), np.array([[0.0, 0.6, 0.8]]))
    assert_allclose(logits[:, 0], [5, 7, 0.8], rtol=1e-6)


def test_lobes_are_a_mean() -> None:
    lobes = np.array([[0, 0, 1, 2], [1, 0, 0, 0]], np.float32)
    colour = BasisColour(mlp(np.eye(6)), lobes)
    features = np.arange(6, dtype=np.float32)[:, None]
    d = np.array([[0.6, 0.0, 0.8]])
    lobe = np.array([np.exp(2 * (0.8 - 1)), 1]) / 2
    assert_allclose(colour.logits(features, d)[:, 0], [lobe @ [0, 1], lobe @ [2, 3], lobe @ [4, 5]], rtol=1e-6)


@pytest.mark.parametrize(
    ("kind", "expected"),
    [
        ("relu", [0, 0, 0.5, 80]),
        ("softplus", [3.720076e-44, 0.313261687518, 0.974076984180, 80]),
        ("exponential", [3.720076e-44, 0.367879441171, 1.648721270700, 5.540622384e34]),
    ],
)
def test_activations(kind: str, expected: list[float]) -> None:
    grey = HeadColour(mlp(np.zeros((3, 1))), "none")
    one = np.ones(1, np.float32)
    network = Network(Frequencies(np.zeros(0)), mlp([[1, 0, 0]]), one, 0.0, Activation(kind), grey)  # type: ignore[arg-type]
    raw = np.array([[-100, -1, 0.5, 80]], np.float32)
    assert_allclose(network.density_of(raw), np.array(expected, np.float32), rtol=1e-6, atol=1e-12)


def test_spherical_harmonics_of_a_network_are_those_of_octrees() -> None:
    colour, directions = BasisColour(mlp(np.ones((27, 1)))), fibonacci(20)
    features = np.ones((1, 20), np.float32)
    assert_allclose(colour.logits(features, directions)[2], sh_basis(directions, 9).sum(axis=1), atol=1e-6)


def test_layers_that_do_not_fit_are_refused() -> None:
    with pytest.raises(InvalidScene, match="layer 1 of the network"):
        mlp(np.zeros((4, 3)), np.zeros((2, 5)))
    grid = HashGrid(np.zeros((4, 2), np.float32), np.array([0, 4]), np.ones(1, np.float32), np.zeros(1, np.int64), 0.0)
    grey = HeadColour(mlp(np.zeros((3, 1))), "none")
    with pytest.raises(InvalidScene, match="takes 3 inputs; allowed: 2"):
        Network(grid, mlp([[1, 0, 0]]), np.ones(1, np.float32), 0.0, Activation(), grey)
    with pytest.raises(InvalidScene, match="levels from row"):
        HashGrid(grid.table, np.array([0, 5]), grid.scale, grid.dense, 0.0)
