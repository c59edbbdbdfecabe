"""KiloNeRF's fine-tuned checkpoints: networks against their own formula, a real layout against answers."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from nerfbake import FunctionField, load
from nerfbake.cli.main import run
from nerfbake.errors import InvalidFile, InvalidScene
from nerfbake.formats.field import kilonerf as reader
from nerfbake.formats.wire.torch_writer import Raw, glob, torch_file
from nerfbake.scene.network_grid import NetworkGrid
from tests.support.nerfs import (
    CELLS,
    DIRECTIONS,
    DOMAIN,
    KILONERF_YAML,
    POINTS,
    kilonerf,
    kilonerf_answers,
    kilonerf_file,
    misfits,
)

YAML = {"lego.yaml": KILONERF_YAML.encode()}
INSIDE = DOMAIN[0] + (POINTS / 2.8 + 0.5) * (DOMAIN[1] - DOMAIN[0])


def read(layers: Any, files: dict[str, bytes] = YAML) -> FunctionField:
    return reader.decode(memoryview(kilonerf_file(layers)), beside={name: memoryview(f) for name, f in files.items()})


@pytest.mark.parametrize("bmm", [False, True])
def test_each_cell_has_its_network(bmm: bool) -> None:
    layers, points = kilonerf(1), np.concatenate([INSIDE, POINTS])
    directions = np.concatenate([DIRECTIONS, DIRECTIONS])
    field = read(kilonerf(1, bmm=bmm))
    density, features = field.density(points)
    expected, colour = kilonerf_answers(layers, points, directions)
    assert 100 < np.count_nonzero(density) < 350
    assert_allclose(density, expected, rtol=1e-5, atol=1e-5)
    shown = density > 0
    assert_allclose(field.colour(features, directions)[shown], colour[shown], atol=1e-5)
    assert field.problems() == []
    assert (field.background, field.dialect) == ((1, 1, 1), "KiloNeRF")


def test_the_program_has_no_density_near_the_faces_of_the_domain() -> None:
    layers = kilonerf(1)
    layers["alpha_linear.bias"] += 20
    points = np.array([[0.9995, 0, 0.7], [0.9985, 0, 0.7], [0, 0.4995, 0.7], [0, 0, 0.0005], [0, 0, 0.0015]])
    assert_array_equal(read(layers).density(points)[0] > 0, [False, True, False, False, True])


def test_cells_that_are_not_occupied_are_empty() -> None:
    layers = kilonerf(1)
    layers["alpha_linear.bias"] += 20
    cells = np.zeros((2, 3, 4), bool)
    cells[1, 2, 0] = True
    field = read(layers, YAML | {"occupancy.pth": torch_file(cells)})
    points = DOMAIN[0] + np.random.default_rng(2).random((400, 3)) * (DOMAIN[1] - DOMAIN[0])
    inside = (points[:, 0] > 0) & (points[:, 1] > 1 / 6) & (points[:, 2] < 0.375)
    expected = read(layers).density(points)[0] * inside
    assert 10 < np.count_nonzero(expected) < 50
    assert_array_equal(field.density(points)[0], expected)
    assert not any("occupancy" in note for note in field.notes)
    assert any("occupancy.pth is not beside it" in note for note in read(layers).notes)


def test_the_settings_may_be_in_several_files() -> None:
    distilled = {
        "distill.yaml": b"fixed_resolution:\n- 2\n- 1\n- 3\n",
        "finetune.yml": b"blender_white_background: false",
    }
    field = read(kilonerf(), distilled | {"bbox.txt": b"-1 -0.5 0 1.0 0.5 1.5 0.4\n"})
    assert isinstance(field.network, NetworkGrid)
    assert (field.network.cells, field.background) == (CELLS, (0, 0, 0))
    assert_allclose(field.network.domain, DOMAIN)


@pytest.mark.parametrize(
    ("files", "message"),
    [
        (
            {},
            r"the files beside it have no fixed_resolution, and .* 6 networks are; allowed: the run's YAML files with",
        ),
        (
            {"a.yaml": b"fixed_resolution: [2, 1, 3]"},
            r"have no global_domain_min and global_domain_max; allowed: a YAML",
        ),
        ({"a.yaml": b"fixed_resolution: [2, 2, 2]"}, r"a\.yaml: fixed_resolution is \[2, 2, 2\]; .* product 6"),
        ({"a.yaml": b"fixed_resolution: [-2, -1, 3]"}, r"is \[-2, -1, 3\]; .* product 6"),
        ({"a.yaml": b"fixed_resolution: 6"}, r"a\.yaml: fixed_resolution is 6; .* product 6"),
        ({"a.yaml": KILONERF_YAML.replace("- 1.5", "- -1").encode()}, r"global_domain_min is no box"),
        ({"a.yaml": KILONERF_YAML.replace("- 1.5", "- .nan").encode()}, r"global_domain_min is no box"),
        ({"a.yaml": KILONERF_YAML.replace("- 1.5", "").encode()}, r"global_domain_max is \[1, 0\.5\]; allowed: three"),
        ({"a.yaml": b"fixed_resolution: [2, 1, 3]", "bbox.txt": b"0 0 0 1 one 1"}, r"bbox\.txt has no six numbers"),
        ({"a.yaml": b"fixed_resolution: [2, 1, 3]", "bbox.txt": b"0 0 0 1 1 inf"}, r"bbox\.txt is no box"),
        (
            YAML | {"z.yaml": b"use_global_coordinates: true"},
            r"z\.yaml: use_global_coordinates is True; allowed: false",
        ),
        (YAML | {"occupancy.pth": torch_file(np.ones(6, bool))}, r"occupancy\.pth has shape \(6,\), dtype bool"),
        (YAML | {"occupancy.pth": torch_file({"x": 1})}, r"occupancy\.pth is not an array"),
        (YAML | {"occupancy.pth": b"PK"}, r"zip"),
    ],
)
def test_what_is_beside_it_is_checked(files: dict[str, bytes], message: str) -> None:
    with pytest.raises(InvalidFile, match=message) as caught:
        read(kilonerf(), files)
    assert len(str(caught.value)) < 300


def test_layers_that_do_not_fit_are_named() -> None:
    for key, layers in misfits(kilonerf()):
        with pytest.raises((InvalidFile, InvalidScene)) as caught:
            read(layers)
        assert len(str(caught.value)) < 300, key
    for key, array in kilonerf().items():  # one network less than the others
        with pytest.raises((InvalidFile, InvalidScene)):
            read(kilonerf() | {key: array[:-1]})


def test_a_distilled_checkpoint_is_refused_in_a_sentence() -> None:
    made = torch_file({"root_nodes": [Raw(glob("__main__", "Node")), Raw(glob("multi_modules", "MultiNetwork"))]})
    assert reader.recognise(memoryview(made))
    with pytest.raises(
        InvalidFile, match=r"it is a distilled checkpoint; allowed: a fine-tuned checkpoint \(checkpoint_"
    ):
        reader.decode(memoryview(made))


def test_nan_is_reported() -> None:
    layers = kilonerf()
    layers["pts_linears.1.weight"][2, 3, 1] = np.nan
    layers["rgb_linear.bias"][0, 0] = np.inf
    places = [problem.place.partition("[")[0] for problem in read(layers).problems()]
    assert places == ["the networks", "the networks of colours"]


def test_commands_take_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "checkpoint_0600000.pth"
    path.write_bytes(kilonerf_file(kilonerf()))
    assert run(["check", str(path)]) == 1
    assert "the files beside it have no fixed_resolution" in capsys.readouterr().out
    (tmp_path / "lego.yaml").write_text(KILONERF_YAML)
    (tmp_path / "occupancy.pth").write_bytes(torch_file(np.ones((2, 2, 2), bool)))
    assert run(["check", str(path)]) == 0
    assert load(path, FunctionField).occupied is not None


@pytest.mark.data
def test_real_answers(data: Path) -> None:
    """Twelve untrained networks, in cells of the edge 2."""
    view = memoryview((data / "fields" / "kilonerf" / "untrained_checkpoint_0000000.pth").read_bytes())
    text = b"fixed_resolution: [3, 2, 2]\nglobal_domain_min: [-3, -2, -2]\nglobal_domain_max: [3, 2, 2]\n"
    field = reader.decode(view, beside={"a.yaml": memoryview(text)})
    answers = np.load(data / "fields" / "kilonerf" / "answers.npz")
    network, raw = field.network, answers["raw"].reshape(-1, 4)
    assert isinstance(network, NetworkGrid)
    features = network.features_in(np.repeat(np.arange(12), 20), answers["local_points"].reshape(-1, 3))
    assert_allclose(network.density_of(features), np.maximum(raw[:, 3], 0), atol=1e-6)
    logits = network.logits(features, answers["dirs"].reshape(-1, 3).astype(float))
    assert_allclose(logits.T, raw[:, :3], atol=2e-6)
