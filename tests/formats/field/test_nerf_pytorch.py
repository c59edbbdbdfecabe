"""nerf-pytorch's checkpoints: a network against its own formula, a real one against the program's answers."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from nerfbake import FunctionField, load
from nerfbake.cli.main import run
from nerfbake.errors import InvalidFile, InvalidScene
from nerfbake.formats.field import nerf_pytorch as reader
from nerfbake.scene.camera import Camera
from tests.support.nerfs import (
    DIRECTIONS,
    POINTS,
    linear,
    misfits,
    nerf_pytorch,
    nerf_pytorch_answers,
    nerf_pytorch_file,
)

BLENDER = b"dataset_type = blender\nwhite_bkgd = True\nno_ndc = False\n"


def read(data: bytes, **files: bytes) -> FunctionField:
    beside = {f"{name}.txt": memoryview(text) for name, text in files.items()}
    return reader.decode(memoryview(data), beside=beside)


@pytest.mark.parametrize("directions", [True, False])
def test_it_is_the_fine_network(directions: bool) -> None:
    layers = nerf_pytorch(1, directions=directions)
    field = read(nerf_pytorch_file(layers))
    density, features = field.density(POINTS)
    expected, colour = nerf_pytorch_answers(layers, POINTS, DIRECTIONS)
    assert 20 < np.count_nonzero(density) < 180
    assert_allclose(density, expected, rtol=1e-5, atol=1e-6)
    assert_allclose(field.colour(features, DIRECTIONS), colour, atol=1e-6)
    assert field.problems() == []


def test_without_a_fine_network_it_is_the_coarse_one() -> None:
    layers = nerf_pytorch(2)
    density = read(nerf_pytorch_file(None, layers)).density(POINTS)[0]
    assert_allclose(density, nerf_pytorch_answers(layers, POINTS, DIRECTIONS)[0], rtol=1e-5, atol=1e-6)


def test_the_wall_at_the_far_end_is_outside_of_the_box() -> None:
    """Cameras are at 4 and rays end at 6: the program makes an opaque wall of any density there."""
    layers = nerf_pytorch(1)
    layers["alpha_linear.bias"] += 10
    field = read(nerf_pytorch_file(layers))
    around = np.array([[1.49, -1.49, 1.49], [1.51, 0, 0], [0, -2.0, 0]])
    assert_array_equal(field.density(around)[0] > 0, [True, False, False])
    assert (field.near, field.far) == (2, 6)


def test_settings_are_those_beside_it() -> None:
    data = nerf_pytorch_file(nerf_pytorch())
    assert read(data, args=BLENDER).background == (1, 1, 1)
    assert read(data, config=b"# made by hand\ndataset_type=blender\n").background == (0, 0, 0)
    assert read(data, args=BLENDER, config=b"dataset_type = llff").background == (1, 1, 1)
    assert not any("assumed, as of" in note for note in read(data, args=BLENDER).notes)
    alone = read(data)
    assert alone.background is None
    assert any("args.txt is not beside it" in note for note in alone.notes)
    spherical = read(data, args=b"dataset_type = llff\nno_ndc = True\nspherify = True")
    assert any("llff capture" in note for note in spherical.notes)


def test_a_forward_facing_scene_is_refused() -> None:
    data = nerf_pytorch_file(nerf_pytorch())
    for text in (b"dataset_type = llff\n", b"dataset_type = llff\nno_ndc = False\n", b"expname = fern\n"):
        with pytest.raises(InvalidFile, match=r"args\.txt describes a forward-facing scene \(NDC\); allowed: "):
            read(data, args=text)
    with pytest.raises(InvalidFile, match=r"config\.txt has 70,000 bytes"):
        read(data, config=b"x" * 70_000)


def test_a_scene_that_changes_with_time_is_refused() -> None:
    layers = {f"_occ.{key}": value for key, value in nerf_pytorch().items()}
    layers |= linear(np.random.default_rng(0), "_time.0", 6, 30)
    with pytest.raises(InvalidFile, match="D-NeRF, whose scene changes with time; allowed: a NeRF without a time axis"):
        read(nerf_pytorch_file(layers, layers))


@pytest.mark.parametrize("directions", [True, False])
def test_layers_that_do_not_fit_are_named(directions: bool) -> None:
    for key, layers in misfits(nerf_pytorch(directions=directions)):
        if not directions and key.startswith("views"):
            continue
        with pytest.raises((InvalidFile, InvalidScene)) as caught:
            read(nerf_pytorch_file(layers))
        assert len(str(caught.value)) < 300


def test_a_layer_that_is_missing_is_named() -> None:
    layers = {key: value for key, value in nerf_pytorch().items() if not key.startswith("alpha")}
    with pytest.raises(InvalidFile, match=r"network_fine_state_dict has no alpha_linear\.weight"):
        read(nerf_pytorch_file(layers))
    with pytest.raises(InvalidFile, match="has 0 layers for positions"):
        read(nerf_pytorch_file({"x": np.ones(1, np.float32)}))
    with pytest.raises(InvalidFile, match=r"views_linears\.0 takes 14 inputs for a position or direction"):
        read(nerf_pytorch_file(nerf_pytorch() | {"views_linears.0.weight": np.ones((5, 20), np.float32)}))


def test_nan_is_reported() -> None:
    layers = nerf_pytorch()
    layers["pts_linears.1.weight"][2, 3] = np.nan
    layers["feature_linear.weight"][0, 0] = np.inf
    places = [problem.place for problem in read(nerf_pytorch_file(layers)).problems()]
    assert [place.partition("[")[0] for place in places] == ["the network", "the network of colours"]


def test_commands_take_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Also beside DirectVoxGO's files of the same extension, and without one."""
    for name in ("000007.tar", "renamed"):
        (tmp_path / name).write_bytes(nerf_pytorch_file(nerf_pytorch()))
        (tmp_path / "args.txt").write_bytes(BLENDER)
        assert load(tmp_path / name, FunctionField).background == (1, 1, 1) if name != "renamed" else True
        assert run(["check", str(tmp_path / name)]) == 0
    (tmp_path / "args.txt").write_bytes(b"dataset_type = llff")
    capsys.readouterr()
    assert run(["check", str(tmp_path / "000007.tar")]) == 1
    assert "args.txt describes a forward-facing scene" in capsys.readouterr().out


# -- a real one ------------------------------------------------------------------------------------------------
@pytest.fixture(scope="module")
def real(data: Path) -> tuple[FunctionField, Any]:
    folder = data / "fields" / "nerf_pytorch"
    return load(folder / "001500.tar", FunctionField), np.load(folder / "answers.npz")


@pytest.mark.data
def test_real_answers(real: tuple[FunctionField, Any]) -> None:
    field, answers = real
    points, directions = (answers[name].astype(float) for name in ("points", "dirs"))
    directions /= np.sqrt((directions**2).sum(axis=1, keepdims=True))
    density, features = replace(field, box=2 * field.box).density(points)
    assert_allclose(density, np.maximum(answers["raw"][:, 3], 0), rtol=1e-5, atol=1e-5)
    colour = 1 / (1 + np.exp(-answers["raw"][:, :3].astype(float)))
    assert_allclose(field.colour(features, directions), colour, atol=1e-6)
    assert field.background == (1, 1, 1)


@pytest.mark.data
@pytest.mark.slow
def test_real_rays_go_through_the_corners_of_pixels(real: tuple[FunctionField, Any]) -> None:
    """A march of some pixels is nearer to the program's picture with cx and cy half a pixel larger."""
    field, answers = real
    fx, _, cx, cy, width, height = (float(each) for each in answers["K"])
    pose = np.vstack([answers["c2w"][0].astype(float), [0, 0, 0, 1]])
    pixels = np.arange(0, 64 * 64, 13)
    found = []
    for shift in (0.5, 0.0):
        camera = Camera(int(width), int(height), fx, pose, centre=(cx + shift, cy + shift))
        eye, directions = camera.rays()
        picture = march(field, eye, directions[pixels])
        error = np.mean(np.square(picture - answers["images"][0].reshape(-1, 3)[pixels]))
        found.append(-10 * np.log10(error))
    corner, centre = found
    assert corner > 33  # 35.0 dB of each 7th pixel, against 23.4
    assert centre < 26


def march(field: FunctionField, eye: Any, directions: Any, steps: int = 200) -> Any:
    """(m, 3) colours of rays on white, from samples along all of the box, whose corners are 2.6 from the origin."""
    edge = 5.2 / steps
    depths = 1.4 + edge * (np.arange(steps) + 0.5)
    places = (eye + directions[:, None] * depths[:, None]).reshape(-1, 3)
    density, features = field.density(places)
    opacity = 1 - np.exp(-density.reshape(-1, steps).astype(float) * edge)
    light = np.cumprod(np.concatenate([np.ones((len(opacity), 1)), 1 - opacity], axis=1), axis=1)
    colour = field.colour(features, np.repeat(directions, steps, axis=0)).reshape(-1, steps, 3)
    return ((light[:, :-1] * opacity)[..., None] * colour).sum(axis=1) + light[:, -1:]
