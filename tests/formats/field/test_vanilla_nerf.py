"""nerfstudio's vanilla-nerf against its own formula, and its relatives, which are refused."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose

from nerfbake import FunctionField
from nerfbake.errors import InvalidFile, InvalidScene
from nerfbake.formats.field import nerfstudio
from nerfbake.formats.field.vanilla_nerf import field_of_vanilla_nerf
from tests.support.nerfs import (
    DIRECTIONS,
    POINTS,
    linear,
    misfits,
    vanilla_nerf,
    vanilla_nerf_answers,
    vanilla_nerf_file,
)


def read(data: bytes) -> FunctionField:
    return nerfstudio.decode(memoryview(data))


def test_it_is_the_fine_field() -> None:
    layers = vanilla_nerf(1)
    field = read(vanilla_nerf_file(layers))
    density, features = field.density(POINTS)
    expected, colour = vanilla_nerf_answers(layers, POINTS, DIRECTIONS)
    assert np.ptp(expected) > 0.3
    assert_allclose(density, expected, rtol=1e-5)
    assert_allclose(field.colour(features, DIRECTIONS), colour, atol=1e-6)
    assert (field.background, field.near, field.far) == ((1, 1, 1), 2, 6)
    assert field.problems() == []


def test_frequencies_are_no_powers_of_two() -> None:
    """With 2^k the middle ones of 3 would be at 2, and with k of 0 to 8 they are at 16."""
    encoding = read(vanilla_nerf_file(vanilla_nerf())).network.encoding  # type: ignore[attr-defined]
    assert_allclose(encoding.frequencies, [1, 16, 256], rtol=1e-6)
    assert_allclose(encoding(np.array([[1 / 64, 0, 0]]))[[3, 4]], [[np.sin(np.pi / 32)], [1]], rtol=1e-5)


def test_depths_of_the_run_make_the_box() -> None:
    model = nerfstudio.NerfstudioModel(memoryview(vanilla_nerf_file(vanilla_nerf())))
    field = field_of_vanilla_nerf(model, np.eye(3, 4), near=0.5, far=1.5, background=0.0)
    assert_allclose(field.box, [[-0.375] * 3, [0.375] * 3])
    assert field.background == (0, 0, 0)


def test_layers_that_do_not_fit_are_named() -> None:
    for key, layers in misfits(vanilla_nerf()):
        if key.startswith("field_fine"):
            with pytest.raises((InvalidFile, InvalidScene)) as caught:
                read(vanilla_nerf_file(layers))
            assert len(str(caught.value)) < 300


def test_relatives_are_refused_in_a_sentence() -> None:
    random = np.random.default_rng(0)
    cones = linear(random, "field.mlp_base.layers.0", 6, 99)
    with pytest.raises(InvalidFile, match="is a mip-NeRF, whose samples are cones and not points; allowed: "):
        read(vanilla_nerf_file(cones))
    moving = vanilla_nerf() | linear(random, "temporal_distortion.mlp_deform.layers.0", 6, 8)
    with pytest.raises(InvalidFile, match="is a scene that changes with time; allowed: a NeRF without a time axis"):
        read(vanilla_nerf_file(moving))
