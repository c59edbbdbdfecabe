"""SVRaster's checkpoints: the voxels stand where they stand, with the densities and colours that its formulas give."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from nerfbake import N3Tree, load
from nerfbake.formats.field import svraster
from nerfbake.formats.wire.torch_writer import torch_file
from nerfbake.kernels.march.sh import sh_basis
from tests.support.hostile import refused_as_it_is
from tests.support.svraster import coded, mean_density, svraster_file, voxels
from tests.support.svraster import svraster as checkpoint


def decoded(data: bytes) -> N3Tree:
    return svraster.decode(memoryview(data))


def test_one_voxel_by_hand(tmp_path: Path) -> None:
    # Level 2, cell (3, 0, 1): x is in the upper half twice, z in the upper half of the lower half.
    raw = np.array([2, 2, 2, 2, 3, 3, 3, 3], np.float32)  # sorted corners: x first
    root: dict[str, Any] = {
        "active_sh_degree": 0,
        "scene_center": np.array([1, 2, 3], np.float32),
        "scene_extent": np.array([8], np.float32),
        "inside_extent": np.array([8], np.float32),
        "octpath": np.array([[(0b100 << 3 | 0b101) << 42]]),
        "octlevel": np.array([[2]], np.int8),
        "_geo_grid_pts": raw[:, None],
        "_sh0": np.array([[0.5, 0, -0.5]], np.float32),
        "_shs": np.zeros((1, 15, 3), np.float32),
        "quantized": False,
    }
    (tmp_path / "a.pt").write_bytes(torch_file(root))
    tree = load(tmp_path / "a.pt", N3Tree)
    # The cube starts at (-3, -2, -1); the voxel has edge 2 and its centre at (-3, -2, -1) + (7, 1, 3).
    places = np.array([[4, -1, 2], [2.9, -1, 2], [4, 0.1, 2], [4, -1, 0.9]])
    inside, *outside = tree.sample(places)
    assert not np.any(outside)
    assert inside[3] == 250  # the mean of 2.25 and 2.75, all above the bend of the activation, times 100
    shown = 1 / (1 + np.exp(-inside[:3] * 0.28209479))
    np.testing.assert_allclose(shown, [0.5 + 0.5 * 0.28209479, 0.5, 0.5 - 0.5 * 0.28209479], atol=1e-5)
    assert (tree.data_format, tree.shells, tree.dialect) == ("SH1", 1, "SVRaster")
    assert [note.split(",")[0] for note in tree.notes] == [
        "the density of a voxel is the mean of 8 points",
        "colours are fitted behind a sigmoid",
    ]


@pytest.mark.parametrize("seed", range(3))
def test_every_voxel_has_the_mean_of_its_density(seed: int) -> None:
    scene = voxels(seed)
    tree = decoded(svraster_file(scene))
    expected = [mean_density(scene, voxel) for voxel in range(len(scene.levels))]
    np.testing.assert_allclose(tree.sample(scene.middles)[:, -1], expected, rtol=1e-5)
    for side in (-0.49, 0.49):
        assert np.array_equal(tree.sample(scene.middles + side * scene.edges[:, None]), tree.sample(scene.middles))
    assert int((tree.leaf_mask & (tree.sigma > 0)).sum()) == len(scene.levels)
    assert not tree.problems()


@pytest.mark.parametrize("degree", range(4))
def test_colours_are_those_of_svraster(degree: int) -> None:
    scene = voxels(degree=degree)
    scene = replace(scene, sh=scene.sh * np.float32(0.25))  # without colours beyond black and white
    B = (degree + 1) ** 2
    values = decoded(svraster_file(scene)).sample(scene.middles)[:, :-1].reshape(-1, 3, B)
    ways = np.random.default_rng(1).normal(size=(60, 3))
    basis = sh_basis(ways / np.linalg.norm(ways, axis=1, keepdims=True), B)
    theirs = np.einsum("db,nbc->ndc", basis, scene.sh[:, :B]) + 0.5
    ours = 1 / (1 + np.exp(-np.einsum("db,ncb->ndc", basis, values)))
    errors = np.abs(ours - theirs)
    assert np.median(errors) < 1 / 255
    assert errors.max() < 0.04


def test_a_scene_around_the_inner_cube_has_shells() -> None:
    tree = decoded(svraster_file(voxels(outside=2)))
    assert (tree.shells, tree.resolution) == (3, 16)
    assert not tree.problems()
    assert np.allclose(1 / tree.inner_cube().invradius, 4)


def test_quantised_numbers_are_read() -> None:
    scene = voxels(2)
    plain, coded = (decoded(svraster_file(scene, quantised=each)) for each in (False, True))
    rows = [tree.sample(scene.middles) for tree in (plain, coded)]
    np.testing.assert_allclose(rows[1][:, -1], rows[0][:, -1], rtol=0.06)
    np.testing.assert_allclose(rows[1][:, :-1], rows[0][:, :-1], atol=0.2)


@pytest.mark.parametrize("quantised", [False, True])
def test_a_model_of_a_lower_degree_has_fewer_coefficients(quantised: bool) -> None:
    """SVRaster's setting model.sh_degree; 3 if it is not set."""
    whole = checkpoint(SCENE, quantised=quantised)
    fewer = whole | {"_shs": whole["_shs"][:3] if quantised else whole["_shs"][:, :3]}
    np.testing.assert_array_equal(decoded(torch_file(fewer)).data, decoded(torch_file(whole)).data)


def test_a_checkpoint_becomes_an_octree(tmp_path: Path) -> None:
    from nerfbake.jobs import bake_octree

    scene = voxels(1)
    (tmp_path / "a.pt").write_bytes(svraster_file(scene))
    octree = bake_octree(tmp_path / "a.pt", tmp_path / "a.svo.npz")
    assert octree.size == (16, 16, 16)
    solid = octree.sample(scene.middles)[:, -1]
    expected = np.array([mean_density(scene, voxel) for voxel in range(len(scene.levels))])
    np.testing.assert_allclose(solid[expected > 2], expected[expected > 2], rtol=1e-2)


# -- hostile files ---------------------------------------------------------------------------------------------
SCENE = voxels(0, depth=3)
ROOT, CODED = (checkpoint(SCENE, quantised=each) for each in (False, True))


def changed(**changes: Any) -> bytes:
    return torch_file(ROOT | changes)


def first(key: str, value: int) -> np.ndarray:
    array = ROOT[key].copy()
    array[0] = value
    return np.asarray(array)


LIES: dict[str, tuple[bytes, str]] = {
    "no voxels": (torch_file({"model": 1}), "data.pkl has no octpath; allowed: a checkpoint of SVRaster"),
    "level 0": (changed(octlevel=first("octlevel", 0)), "octlevel is 0 to"),
    "level 17": (changed(octlevel=first("octlevel", 17)), "to 17; allowed: 1 to 16"),
    "fewer levels": (changed(octlevel=ROOT["octlevel"][1:]), "octlevel has"),
    "another type": (changed(octlevel=ROOT["octlevel"].astype(np.int64)), "dtype int64; allowed: (n, 1) int8"),
    "bits below": (changed(octpath=first("octpath", 1)), "octpath has numbers that are no voxels"),
    "a negative path": (changed(octpath=first("octpath", -8)), "octpath has numbers that are no voxels"),
    "twice": (changed(octpath=first("octpath", int(ROOT["octpath"][1, 0]))), "octpath has "),
    "too few corners": (changed(_geo_grid_pts=ROOT["_geo_grid_pts"][1:]), "the corners of the voxels"),
    "NaN": (changed(_geo_grid_pts=ROOT["_geo_grid_pts"] * np.float32(np.nan)), "numbers that are not finite"),
    "degree 4": (changed(active_sh_degree=4), "active_sh_degree is 4; allowed: 0 to 3"),
    "no extent": (changed(scene_extent=np.zeros(1, np.float32)), "scene_extent is [0.]"),
    "an odd extent": (changed(inside_extent=np.full(1, 3, np.float32)), "inside_extent is 3 of 4"),
    "no colours": (changed(_sh0=None), "_sh0 is not an array"),
    "fewer colours": (changed(_sh0=ROOT["_sh0"][1:]), "_sh0 has"),
    "not coded": (changed(quantized=True), "has no codebook"),
    "fewer bands": (changed(_shs=ROOT["_shs"][:, :2]), "_shs has "),
    "codes of other rows": (
        torch_file(CODED | {"_sh0": [*CODED["_sh0"][:2], coded(np.arange(3.0)[:, None])]}),
        "_sh0 has 3 rows",
    ),
    "a short codebook": (
        torch_file(CODED | {
            "_geo_grid_pts": {"index": np.full((3, 1), 9, np.uint8), "codebook": np.zeros(9, np.float32)}
        }),
        "_geo_grid_pts.index has uint8 up to 9; allowed: uint8 below 9",
    ),
}  # fmt: skip


@pytest.mark.parametrize("lie", LIES)
def test_a_lying_checkpoint_is_one_line(lie: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    content, told = LIES[lie]
    assert told in refused_as_it_is(tmp_path / "bad.pt", content, capsys)


def test_voxels_inside_others_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    nested = np.array([[0], [1 << 42]])
    data = changed(octpath=nested, octlevel=np.array([[1], [2]], np.int8))
    assert "octpath has voxels inside others" in refused_as_it_is(tmp_path / "bad.pt", data, capsys)
