"""DirectVoxGO's checkpoints: their formulas at the nodes and between them, their dialects, and what is refused."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from nerfbake import LatticeField, build_octree_from_lattice, load, measure_lattice
from nerfbake.formats.field import dvgo as reader
from nerfbake.formats.wire.torch_writer import TensorView, numpy_array, torch_file
from nerfbake.kernels.lattice.mlp import positional_encoding
from nerfbake.kernels.lattice.nodes import in_nodes, interpolate_rows
from nerfbake.kernels.march.sh import sh_basis
from nerfbake.kernels.maths.elementary import fibonacci
from nerfbake.scene.lattice_field import MlpColour, RgbColour
from nerfbake.stages._lattice import MLP_DIRECTIONS, fit_of, seen_along, table_of
from tests.support.hostile import refused_as_it_is
from tests.support.lattices import CENTRE, RADIUS, SHAPE, affine
from tests.support.scenes import world_centres
from tests.support.torch_files import ACT_SHIFT, BASE, FEATURES, dvgo, dvgo_file

EDGE = float(np.prod(2 * RADIUS.astype(np.float64)) / BASE) ** (1 / 3)


def read(**options: Any) -> LatticeField:
    return reader.decode(memoryview(dvgo_file(dvgo(**options))))


def sines(x: Any, count: int) -> Any:
    angles = (x[:, :, None] * 2.0 ** np.arange(count)).reshape(len(x), -1)
    return np.concatenate([x, np.sin(angles), np.cos(angles)], axis=1)


def mlp_of(checkpoint: dict[str, Any], features: Any, directions: Any) -> Any:
    """torch's Linear, y = x W^T + b, in float64: (m, n, 3) logits of features (m, F) in directions (n, 3)."""
    state = checkpoint["model_state_dict"]
    code = sines(directions, 4)
    m, n = len(features), len(directions)
    x = np.concatenate([np.repeat(features, n, 0), np.tile(code, (m, 1))], axis=1)
    for name, last in (("rgbnet.0", False), ("rgbnet.2.0", False), ("rgbnet.3", True)):
        x = x @ state[f"{name}.weight"].astype(np.float64).T + state[f"{name}.bias"]
        x = x if last else np.maximum(x, 0)
    return x.reshape(m, n, 3)


@pytest.mark.parametrize("dialect", ["grid", "early", "2021", "planes"])
def test_densities_follow_its_formula(dialect: str) -> None:
    lattice = read(dialect=dialect)
    assert lattice.at_corners
    assert_allclose(lattice.box, np.stack([CENTRE - RADIUS, CENTRE + RADIUS]))
    assert lattice.least == (0 if dialect == "2021" else 1e-4)
    octree = build_octree_from_lattice(lattice, basis="SH1")
    points = world_centres(octree)
    shift = ACT_SHIFT if dialect in ("grid", "planes") else np.log(1 / (1 - 1e-2) - 1)
    density = np.logaddexp(0, affine(points) + shift) / EDGE
    density[1 - np.exp(-density * lattice.step) <= lattice.least] = 0
    clear = np.abs(1 - np.exp(-density * lattice.step) - 1e-4) > 1e-6
    assert_allclose(octree.sample(points)[clear, -1], density[clear], rtol=1e-4, atol=1e-6)


def test_a_linear_mlp_is_four_harmonics_exactly() -> None:
    """Logits a + b . d: c0 = a / Y00, c1 = -b_y / Y1, c2 = b_z / Y1, c3 = -b_x / Y1."""
    checkpoint, lattice = dvgo(), read()
    features = np.random.default_rng(0).normal(0, 0.5, (70, FEATURES)).astype(np.float32)
    a = mlp_of(checkpoint, features, np.zeros((1, 3)))[:, 0]
    b = mlp_of(checkpoint, features, np.eye(3)) - a[:, None]
    expected = np.stack([a / 0.28209479, -b[:, 1] / 0.48860251, b[:, 2] / 0.48860251, -b[:, 0] / 0.48860251], axis=2)
    assert_allclose(fit_of(lattice, 4)(features), expected.reshape(70, 12), atol=2e-3)
    octree = build_octree_from_lattice(lattice, basis="SH4")
    assert measure_lattice(lattice, octree) < 0.01


@pytest.mark.parametrize("direct", [True, False])
def test_colours_are_those_of_its_mlp(direct: bool) -> None:
    checkpoint, lattice = dvgo(mlp="random", direct=direct), read(mlp="random", direct=direct)
    features, directions = table_of(lattice), fibonacci(3)
    assert features.shape == (210, FEATURES + 3 * (not direct))
    own, added = (features, 0) if direct else (features[:, 3:], features[:, None, :3])
    logits = mlp_of(checkpoint, own, directions) + added
    ray = np.tile(np.arange(3), 70)
    seen = seen_along(lattice, directions)(features, ray)
    assert_allclose(seen, 1 / (1 + np.exp(-logits[np.arange(210), ray])), atol=1e-6)


@pytest.mark.parametrize("direct", [True, False])
def test_before_2022_the_mlp_asks_for_positions(direct: bool) -> None:
    """Features, then the place in the box, 0 to 1, with its sines, then the direction: anywhere, not at nodes alone."""
    checkpoint = dvgo(mlp="random", dialect="2021", direct=direct)
    lattice = reader.decode(memoryview(dvgo_file(checkpoint)))
    assert lattice.dialect == "DirectVoxGO, 2021"
    assert lattice.notes[0].startswith("the mask from the coarse lattice is ignored")
    shares, directions = np.random.default_rng(1).random((60, 3)), fibonacci(2)
    at = in_nodes(shares, lattice.shape, lattice.at_corners)
    whole = interpolate_rows(lattice.links, table_of(lattice), at)
    grid = np.moveaxis(checkpoint["model_state_dict"]["k0"][0], 0, -1).reshape(210, -1)
    own = interpolate_rows(lattice.links, np.ascontiguousarray(grid), at)
    k0, added = (own, 0) if direct else (own[:, 3:], own[:, None, :3])
    logits = mlp_of(checkpoint, np.concatenate([k0, sines(shares, 5)], axis=1), directions) + added
    seen = seen_along(lattice, directions)(whole, np.ones(60, np.int64))
    assert_allclose(seen, 1 / (1 + np.exp(-logits[:, 1])), atol=2e-6)


def test_features_may_be_products_of_planes() -> None:
    checkpoint, lattice = dvgo(mlp="random", dialect="planes"), read(mlp="random", dialect="planes")
    xy, xz, yz, z, y, x = (
        checkpoint["model_state_dict"][f"k0.{name}"][0].astype(float)
        for name in ("xy_plane", "xz_plane", "yz_plane", "z_vec", "y_vec", "x_vec")
    )
    formulas = ("rxy,rzi->xyzr", xy, z), ("rxz,ryi->xyzr", xz, y), ("ryz,rxi->xyzr", yz, x)
    parts = np.concatenate([np.einsum(formula, a, b) for formula, a, b in formulas], axis=3)
    expected = parts @ checkpoint["model_state_dict"]["k0.f_vec"]
    assert_allclose(lattice.features.reshape(*SHAPE, FEATURES), expected, atol=1e-5)


def test_coefficients_are_the_least_squares_of_its_logits() -> None:
    checkpoint, lattice = dvgo(mlp="random", direct=False), read(mlp="random", direct=False)
    features, directions = table_of(lattice), fibonacci(MLP_DIRECTIONS)
    logits = mlp_of(checkpoint, features[:, 3:], directions) + features[:, None, :3]
    expected = np.linalg.lstsq(sh_basis(directions, 9), logits.transpose(1, 0, 2).reshape(MLP_DIRECTIONS, -1))[0]
    found = fit_of(lattice, 9)(features).reshape(-1, 3, 9)
    assert_allclose(found, expected.reshape(9, -1, 3).transpose(1, 2, 0), atol=1e-5)


def test_an_encoding_goes_coordinate_by_coordinate() -> None:
    d = np.array([[0.6, 0.0, 0.8]])
    code = positional_encoding(d, (1.0, 2.0))[0]
    assert_allclose(code[3:9], np.sin([0.6, 1.2, 0, 0, 0.8, 1.6]), atol=1e-12)
    assert_allclose(code[9:], np.cos([0.6, 1.2, 0, 0, 0.8, 1.6]), atol=1e-12)


def test_a_coarse_model_has_three_channels_of_colour() -> None:
    lattice, checkpoint = read(mlp="none"), dvgo(mlp="none")
    assert isinstance(lattice.colour, RgbColour)
    grid = checkpoint["model_state_dict"]["k0.grid"]
    assert_array_equal(lattice.features, grid[0].reshape(3, -1).T)
    assert_array_equal(lattice.links.reshape(-1), np.arange(np.prod(SHAPE)))


def test_a_mask_is_read_and_the_optimiser_is_not(tmp_path: Path) -> None:
    checkpoint = dvgo()
    checkpoint["model_state_dict"]["mask_cache.mask"] = np.arange(24).reshape(2, 3, 4) % 5 == 0
    (tmp_path / "fine_last.tar").write_bytes(dvgo_file(checkpoint))  # its optimiser's tensors go past their storages
    lattice = load(tmp_path / "fine_last.tar", LatticeField)
    assert lattice.occupied is not None
    assert_array_equal(lattice.occupied, np.arange(24).reshape(2, 3, 4) % 5 == 0)
    assert isinstance(lattice.colour, MlpColour)
    (tmp_path / "renamed").write_bytes(dvgo_file(checkpoint))
    assert isinstance(load(tmp_path / "renamed"), LatticeField)


def settings(**values: Any) -> Callable[[dict[str, Any]], None]:
    return lambda checkpoint: checkpoint["model_kwargs"].update(values)


def state(**values: Any) -> Callable[[dict[str, Any]], None]:
    return lambda checkpoint: checkpoint["model_state_dict"].update(
        {key.replace("__", "."): value for key, value in values.items()}
    )


def without(key: str) -> Callable[[dict[str, Any]], None]:
    def change(checkpoint: dict[str, Any]) -> None:
        del checkpoint["model_state_dict"][key]

    return change


GRID = np.zeros((1, 1, *SHAPE), np.float32)
NAN = np.full(3, np.nan, np.float32)
LIES: dict[str, tuple[Callable[[dict[str, Any]], None], str]] = {
    "NDC": (settings(mpi_depth=128), "has mpi_depth: a forward-facing scene (NDC)"),
    "contracted": (settings(scene_center=numpy_array(NAN)), "has scene_center: an unbounded scene"),
    "NDC by its shift": (state(act_shift__grid=GRID), "model_state_dict has act_shift.grid: a forward-facing scene"),
    "nearest nodes": (settings(nearest=True), "has nearest: values of the nearest node, without interpolation"),
    "opacities": (settings(pre_act_density=True), "has pre_act_density: opacities at the nodes"),
    "activated nodes": (settings(in_act_density=1), "has in_act_density: densities that are activated at the nodes"),
    "no grid": (without("density.grid"), "model_state_dict has no density.grid; allowed: a model"),
    "no colours": (without("k0.grid"), "model_state_dict has no k0.grid"),
    "a plane of five axes": (state(k0__xy_plane=GRID, k0__z_vec=GRID), "k0.xy_plane has shape (1, 1, 5, 6, 7)"),
    "a plane alone": (state(k0__xy_plane=GRID[0]), "model_state_dict has no k0.z_vec"),
    "a flat grid": (state(density__grid=np.zeros(9, np.float32)), "density.grid has shape (9,)"),
    "whole numbers": (state(density__grid=GRID.astype(np.int32)), "density.grid has dtype int32"),
    "fewer channels": (state(k0__grid=np.zeros((1, 2, *SHAPE), np.float32)), "allowed: (1, 4, X, Y, Z)"),
    "other nodes": (state(k0__grid=np.zeros((1, 4, 2, 2, 2), np.float32)), "k0 has (2, 2, 2) nodes"),
    "past the end": (state(density__grid=TensorView(np.zeros(9, np.float32), 0, (1, 1, *SHAPE), (210, 210, 42, 7, 1))),
                     "density.grid of shape"),
    "NaN box": (state(xyz_min=NAN), "xyz_min is [nan nan nan]"),
    "a box of two": (state(xyz_min=NAN[:2]), "xyz_min has shape (2,)"),
    "turned box": (state(xyz_min=CENTRE + RADIUS, xyz_max=CENTRE - RADIUS), "num_voxels_base is 1000, over a volume"),
    "no voxels": (settings(num_voxels_base=0), "num_voxels_base is 0"),
    "no number": (settings(num_voxels_base="many"), "num_voxels_base is not an array"),
    "a number beyond all": (settings(num_voxels_base=1 << 62), "num_voxels_base is too large, or not a number"),
    "a threshold of 1": (settings(fast_color_thres=1.0), "fast_color_thres is not an opacity"),
    "NaN threshold": (settings(fast_color_thres={0: float("nan")}), "fast_color_thres is not an opacity"),
    "NaN shift": (state(act_shift=NAN[:1]), "activation[0] is nan"),
    "NaN weight": (state(**{"rgbnet__3__bias": NAN}), "the MLP["),
    "a weight beyond bounds": (state(**{"rgbnet__3__bias": np.full(3, 1e38, np.float32)}), "the MLP["),
    "infinite density": (state(density__grid=GRID + np.inf), "density[0] is inf"),
    "a layer of another width": (state(**{"rgbnet__2__0__weight": GRID[0, 0, 0]}), "rgbnet.2 has weights"),
    "a last layer of four": (state(**{"rgbnet__3__weight": np.zeros((4, 8), np.float32)}), "the MLP's last has shape"),
    "frequencies without an end": (state(viewfreq=np.full(4, 1e9, np.float32)), "frequencies[0] is 1e+09"),
    "a mask of numbers": (state(**{"mask_cache__mask": GRID[0]}), "mask_cache.mask has dtype float32"),
    "no settings": (lambda checkpoint: checkpoint.update(model_kwargs=3), "data.pkl has no model_kwargs"),
}  # fmt: skip


PLANE_LIES: dict[str, tuple[Callable[[dict[str, Any]], None], str]] = {
    "a broad vector": (state(k0__z_vec=np.zeros((1, 3, 7, 2), np.float32)), "k0.z_vec has (7, 2) nodes; allowed: node"),
    "other nodes": (state(k0__x_vec=np.zeros((1, 2, 4, 1), np.float32)), "k0.yz_plane has shape (6, 7, 2)"),
    "more channels": (state(k0__f_vec=np.zeros((7, 5), np.float32)), "k0.f_vec has 5 columns; allowed: 4"),
    "fewer parts": (state(k0__f_vec=np.zeros((6, 4), np.float32)), "k0.f_vec is for (6,) parts; allowed: 7"),
    "another density": (state(density__grid=GRID[..., :3]), "k0 has (5, 6, 7) nodes; allowed: (5, 6, 3)"),
}  # fmt: skip


@pytest.mark.parametrize("lie", PLANE_LIES)
def test_lying_planes_are_refused(lie: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    change, expected = PLANE_LIES[lie]
    checkpoint = dvgo(dialect="planes")
    change(checkpoint)
    assert expected in refused_as_it_is(tmp_path / "bad.tar", dvgo_file(checkpoint), capsys)


@pytest.mark.parametrize("lie", LIES)
def test_a_lying_checkpoint_is_refused(lie: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    change, expected = LIES[lie]
    checkpoint = dvgo()
    change(checkpoint)
    (tmp_path / "bad.tar").write_bytes(dvgo_file(checkpoint))
    if "[" in expected and "xyz" not in expected:  # a value, which no command but `check` looks at before it is used
        found = load(tmp_path / "bad.tar", LatticeField, sound=False).problems()
        assert expected in str(found[0])
        return
    assert expected in refused_as_it_is(tmp_path / "bad.tar", dvgo_file(checkpoint), capsys)


def test_another_files_of_torch_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    said = refused_as_it_is(tmp_path / "bad.tar", torch_file({"state_dict": {}}), capsys)
    assert "data.pkl has no model_kwargs; allowed: a checkpoint of DirectVoxGO" in said
    said = refused_as_it_is(tmp_path / "bad.tar", b"ustar" * 200, capsys)
    assert "is not a complete zip archive" in said
