"""Checkpoints of JaxNeRF, NeRF-SH and NeRF-SG: networks against their own formulas, real ones against answers."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

from nerfbake import FunctionField, load
from nerfbake.cli.main import run
from nerfbake.errors import InvalidFile, InvalidScene
from nerfbake.formats.field import jaxnerf as reader
from nerfbake.scene.network import BasisColour, Network
from tests.support.nerfs import (
    DIRECTIONS,
    POINTS,
    by_frequency,
    jaxnerf,
    jaxnerf_answers,
    jaxnerf_file,
)


def read(parameters: Any, **files: str) -> FunctionField:
    beside = {f"{name}.yaml": memoryview(text.encode()) for name, text in files.items()}
    return reader.decode(memoryview(jaxnerf_file(parameters)), beside=beside)


@pytest.mark.parametrize(
    ("colour", "program"), [("directions", "JaxNeRF"), ("RGB", "JaxNeRF"), ("SH4", "NeRF-SH"), ("SG", "NeRF-SG")]
)
def test_it_is_the_fine_network(colour: str, program: str) -> None:
    parameters = jaxnerf(10, colour)
    field = read(parameters)
    density, features = field.density(POINTS)
    expected, colours = jaxnerf_answers(parameters, POINTS, DIRECTIONS)
    assert 20 < np.count_nonzero(density) < 180
    assert_allclose(density, expected, rtol=1e-5, atol=1e-6)
    assert_allclose(field.colour(features, DIRECTIONS), colours, atol=1e-6)
    assert (field.dialect, field.problems()) == (program, [])


def test_without_a_fine_network_it_is_the_coarse_one() -> None:
    parameters = jaxnerf(10)
    density = read({"MLP_0": parameters["MLP_1"]}).density(POINTS)[0]
    assert_allclose(density, jaxnerf_answers(parameters, POINTS, DIRECTIONS)[0], rtol=1e-5, atol=1e-6)


def test_layers_go_by_number() -> None:
    """The map has Dense_10 before Dense_2."""
    parameters = jaxnerf(10, "RGB")
    deep = parameters["MLP_1"]
    last, density = deep.pop("Dense_5"), deep.pop("Dense_4")
    same = {"kernel": np.eye(6, dtype=np.float32), "bias": np.zeros(6, np.float32)}
    parameters["MLP_1"] = dict(sorted({**deep, **{f"Dense_{k}": same for k in range(4, 12)}}.items()))
    parameters["MLP_1"] |= {"Dense_12": density, "Dense_13": last}
    assert list(parameters["MLP_1"])[2] == "Dense_10"
    assert_allclose(read(parameters).density(POINTS)[0], read(jaxnerf(10, "RGB")).density(POINTS)[0], rtol=1e-5)


def test_the_old_order_of_the_encoding_is_in_the_yaml() -> None:
    parameters = jaxnerf(10)
    field = read(parameters, blender="dataset: blender\nwhite_bkgd: true\nlegacy_posenc_order: true\n")
    density, features = field.density(POINTS)
    expected, colours = jaxnerf_answers(parameters, POINTS, DIRECTIONS, by_frequency)
    assert_allclose(density, expected, rtol=1e-5, atol=1e-5)
    assert_allclose(field.colour(features, DIRECTIONS), colours, atol=1e-5)
    assert field.background == (1, 1, 1)


def test_settings_are_those_of_the_yaml() -> None:
    field = read(jaxnerf(), tt="near: 0.0\nfar: 4.0\nwhite_bkgd: false\nsigma_activation: softplus\n")
    assert_allclose(field.box, [[-1.5] * 3, [1.5] * 3])
    assert (field.near, field.far, field.background) == (0, 4, (0, 0, 0))
    assert isinstance(field.network, Network)
    assert field.network.activation.kind == "softplus"
    assert not any("no YAML" in note for note in field.notes)
    assert any("no YAML" in note for note in read(jaxnerf(), other="lr: 1").notes)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("dataset: llff", r"a\.yaml describes a forward-facing scene \(NDC\)"),
        ("near: 7", r"a\.yaml: near is 7; allowed: near 7 below far 6"),
        ("far: [1]", r"a\.yaml: far is \[1\]; allowed: a number from 0"),
        ("white_bkgd: maybe", r"a\.yaml: white_bkgd is maybe; allowed: true or false"),
        ("sigma_activation: exp", r"a\.yaml: sigma_activation is exp; allowed: relu or softplus"),
        ("near: [", r"a\.yaml at line"),
    ],
)
def test_settings_that_are_refused(text: str, message: str) -> None:
    with pytest.raises(InvalidFile, match=message):
        read(jaxnerf(), a=text)


# -- what is refused -------------------------------------------------------------------------------------------
def changed(**layers: Any) -> Callable[[dict[str, Any]], None]:
    return lambda parameters: parameters["MLP_1"].update(layers)


def layer(inputs: int, outputs: int) -> dict[str, Any]:
    return {"kernel": np.ones((inputs, outputs), np.float32), "bias": np.ones(outputs, np.float32)}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda parameters: parameters["MLP_1"].pop("Dense_2"), "MLP_1 has no Dense_2; allowed: layers that are numb"),
        (lambda parameters: parameters["MLP_1"].clear(), "MLP_1 has no Dense_0"),
        (lambda parameters: parameters.clear(), "has no MLP_1 and no MLP_0"),
        (changed(Dense_1=3), "MLP_1 has no Dense_1"),
        (changed(Dense_1={"kernel": 1.0}), "Dense_1.kernel is not an array"),
        (changed(Dense_1=layer(7, 6)), "Dense_1 takes 7 inputs; allowed: 27"),
        (changed(Dense_0=layer(22, 6)), "Dense_0 takes 22 inputs for a position or direction"),
        (changed(Dense_4=layer(6, 2)), "has 6 layers; allowed: 1 or 3 layers of colours"),
        (changed(Dense_5=layer(6, 11)), "Dense_5 has 11 outputs; allowed: 3 or 12"),
        (changed(Dense_5=layer(5, 12)), "Dense_5 takes 5 inputs; allowed: 6"),
        (changed(Dense_5={**layer(6, 12), "bias": np.ones(3, np.float32)}), "biases of shape"),
        (changed(Dense_5={**layer(6, 12), "bias": np.ones(12, np.int32)}), "has dtype int32; allowed: floats"),
        (changed(Dense_9=layer(3, 3)), "MLP_1 has no Dense_6"),
        (lambda p: p.update(sg_lambda=np.ones(3, np.float32)), "sg_mu_spher is not an array"),
        (lambda p: p.update(sg_lambda=np.ones(3, np.float32), sg_mu_spher=np.ones((4, 2), np.float32)), "has shape"),
    ],
)
def test_a_network_that_does_not_fit_is_named(change: Callable[[Any], object], message: str) -> None:
    parameters = jaxnerf(0, "SH4")
    change(parameters)
    with pytest.raises((InvalidFile, InvalidScene)) as caught:
        read(parameters)
    assert message in str(caught.value)


def test_relatives_are_refused_in_a_sentence() -> None:
    cones = {"MLP_0": {"Dense_0": layer(96, 8), "Dense_1": layer(8, 1), "Dense_2": layer(8, 3)}}
    with pytest.raises(InvalidFile, match="MLP_0 is a mip-NeRF, whose samples are cones and not points; allowed: "):
        read(cones)
    with pytest.raises(InvalidFile, match="params is a mip-NeRF, whose samples are cones"):
        read({"NerfMLP_0": {"Dense_0": layer(96, 8)}, "PropMLP_0": {}})
    with pytest.raises(InvalidFile, match="params is a scene that changes with time; allowed: a checkpoint of JaxNeRF"):
        read({"model": {"warp_field": {}, "nerf_mlps_coarse": {}}})


def test_nan_is_reported() -> None:
    parameters = jaxnerf(0, "SG")
    parameters["MLP_1"]["Dense_1"]["kernel"][2, 3] = np.nan
    parameters["sg_lambda"][1] = np.inf
    places = [problem.place.partition("[")[0] for problem in read(parameters).problems()]
    assert places == ["the network", "the lobes"]
    parameters["sg_mu_spher"][1] = np.nan
    with pytest.raises(InvalidFile, match="sg_mu_spher has angles that are not finite"):
        read(parameters)


def test_commands_take_it_without_an_extension(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "checkpoint_7"
    path.write_bytes(jaxnerf_file(jaxnerf(0, "SH4")))
    (tmp_path / "blender.yml").write_text("dataset: blender\nwhite_bkgd: true\n")
    assert load(path, FunctionField).background == (1, 1, 1)
    assert run(["check", str(path)]) == 0
    path.write_bytes(jaxnerf_file(jaxnerf(0, "SH4"))[:-9])
    assert run(["check", str(path)]) == 1
    assert "bytes that remain" in capsys.readouterr().out


# -- real ones -------------------------------------------------------------------------------------------------
@pytest.mark.data
@pytest.mark.parametrize("name", ["jaxnerf", "nerfsh", "nerfsg"])
def test_real_answers(name: str, data: Path) -> None:
    field = load(data / "fields" / "jaxnerf" / f"{name}_checkpoint_7", FunctionField)
    answers = np.load(data / "fields" / "jaxnerf" / f"{name}_answers.npz")
    points, directions = (answers[key].astype(float) for key in ("points", "dirs"))
    density, features = field.density(points)
    assert_allclose(density, answers["sigma"][:, 0], rtol=2e-6, atol=1.2e-5)  # densities of up to 10 and 31
    assert_allclose(field.colour(features, directions), answers["rgb"], atol=3e-6)
    if name == "nerfsh":
        assert isinstance(field.network, Network)
        assert isinstance(field.network.colour, BasisColour)
        raw = field.network.colour.mlp(np.ascontiguousarray(features.T)).T
        assert_allclose(raw, answers["raw_rgb"], atol=3e-5)  # numbers of up to 30
    assert field.problems() == []
