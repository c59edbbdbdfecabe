"""SNeRG's folders: voxels against its renderer's own lookups, deferred colours, and what is refused."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

from nerfbake import Camera, LatticeField, build_octree_from_lattice, load, render_lattice
from nerfbake.cli.main import run
from nerfbake.formats.field import snerg as reader
from nerfbake.kernels.lattice.harmonics import LEAST
from nerfbake.kernels.lattice.nodes import densities, in_nodes, interpolate_rows
from nerfbake.kernels.march.sh import sh_basis
from nerfbake.kernels.maths.elementary import fibonacci
from nerfbake.scene.lattice_field import DeferredColour
from nerfbake.stages._lattice import MLP_DIRECTIONS, fit_of, nodes_of, places_of, seen_along, table_of
from tests.support.lies import Lie, assert_refused, changed, half_of, no_field, picture, without
from tests.support.plenvdb import written
from tests.support.scenes import world_centres
from tests.support.snerg import (
    ATLAS,
    BLOCKS,
    TURN,
    added,
    colour_at,
    density_of,
    snerg,
    snerg_folder,
    values_at,
)

RANDOM = np.random.default_rng(2)


def read(made: dict[str, Any]) -> LatticeField:
    return reader.decode({name: memoryview(data) for name, data in snerg_folder(made).items()})


def points_in(lattice: LatticeField, count: int) -> Any:
    """Anywhere in the box and beyond, and at its corners."""
    corners = np.stack(np.meshgrid([0.0, 1.0], [0.0, 1.0], [0.0, 1.0]), -1).reshape(-1, 3)
    shares = np.concatenate([RANDOM.uniform(-0.05, 1.05, (count, 3)), corners])
    return lattice.box[0] + shares * (lattice.box[1] - lattice.box[0])


def looked_up(lattice: LatticeField, points: Any) -> tuple[Any, Any]:
    """Densities and features at points, nothing outside of the box."""
    places = places_of(lattice, points)
    inside = ((places >= 0) & (places <= 1)).all(axis=1)
    at = in_nodes(np.clip(places, 0, 1), lattice.shape, lattice.at_corners)
    density = np.where(inside, densities(nodes_of(lattice), np.clip(places, 0, 1)), 0)
    return density, interpolate_rows(lattice.links, table_of(lattice), at)


@pytest.mark.parametrize("diffuse", [False, True])
def test_places_are_what_its_renderer_fetches_there(diffuse: bool) -> None:
    made = snerg(diffuse=diffuse)
    lattice = read(made)
    points = points_in(lattice, 400)
    values = values_at(made, points)
    density, features = looked_up(lattice, points)
    assert_allclose(density, density_of(values), rtol=1e-5, atol=1e-5)
    held = values[:, 7] > 0.02
    assert 20 < np.count_nonzero(held) < 300
    directions = fibonacci(3)
    for ray, direction in enumerate(directions):
        seen = seen_along(lattice, directions)(features[held], np.full(np.count_nonzero(held), ray))
        assert_allclose(seen, colour_at(made, points[held], direction), atol=2e-5)


def test_an_octree_of_it_holds_its_voxels() -> None:
    made = snerg()
    lattice = read(made)
    octree = build_octree_from_lattice(lattice)
    points = world_centres(octree)[::7]
    found = octree.sample(points)
    assert_allclose(found[:, -1], density_of(values_at(made, points)), rtol=1e-5, atol=1e-5)
    held = np.flatnonzero(found[:, -1] > 0.1)[::5]
    directions = fibonacci(MLP_DIRECTIONS)
    seen = np.stack([colour_at(made, points[held], direction) for direction in directions])
    cut = np.clip(seen, LEAST, 1 - LEAST).reshape(len(directions), -1)
    expected = np.linalg.lstsq(sh_basis(directions, 9), np.log(cut / (1 - cut)), rcond=None)[0].T
    assert_allclose(found[held, :-1], expected.reshape(len(held), 27), atol=2e-3)


def test_a_colour_that_is_the_same_everywhere_is_one_coefficient() -> None:
    made = snerg(diffuse=True, alpha=200)
    coefficients = fit_of(read(made), 4)(np.array([[20, 40, 60, 0, 0, 0, 0, 80]], np.float32)).reshape(3, 4)
    colour = np.array([0.25, 0.5, 0.75])
    assert_allclose(coefficients[:, 0], np.log(colour / (1 - colour)) / 0.28209479, atol=1e-4)
    assert_allclose(coefficients[:, 1:], 0, atol=1e-4)


def test_a_pictures_mlp_is_asked_once_for_each_ray() -> None:
    """Voxels of one kind: a ray's sums are its alpha times their values, and what is behind it."""
    made = snerg(alpha=100)
    lattice = read(made)
    pose = np.eye(4)
    pose[:3, 3] = (lattice.box[0] + lattice.box[1]) / 2 + np.array([0.1, 0.2, 9])
    camera = Camera(7, 5, 9.0, pose, "above")
    looks = camera.rays()[1]
    for background in ((1.0, 1.0, 1.0), (0.25, 0.5, 0.0)):
        image = render_lattice(lattice, camera, background=background, transmittance_cut=0)
        alpha = image.alpha.reshape(-1, 1).astype(float)
        assert (alpha == 0).any()
        assert (alpha > 0.5).any()
        sums = np.repeat(alpha * 0.5, 7, axis=1)
        sums[:, :3] += (1 - alpha) * background
        expected = np.where(alpha > 0, np.minimum(sums[:, :3] + added(made, sums, looks), 1), background)
        assert_allclose(image.colour.reshape(-1, 3), expected, atol=1e-5)


def test_a_ray_through_one_voxel_mixes_it_with_what_is_behind() -> None:
    """C = a c + (1 - a), at most."""
    made = snerg(diffuse=True, alpha=0)
    made["atlas"][2, 2, 2] = (40, 80, 20, 0, 0, 0, 0, 100)  # in the block (1, 0, 0), its middle
    lattice = read(made)
    assert lattice.n == 1
    node = np.argwhere(lattice.links == 0)[0]
    pose = np.eye(4)
    pose[:3, 3] = lattice.box[0] + (node + 0.5) * lattice.spacing + (0, 0, 5)
    image = render_lattice(lattice, Camera(1, 1, 1e6, pose, "ahead"), transmittance_cut=0)
    a = float(image.alpha[0, 0])
    assert 0.3 < a < 0.5
    assert_allclose(image.colour[0, 0], a * np.array([0.4, 0.8, 0.2]) + 1 - a, atol=1e-5)


def test_commands_take_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = written(tmp_path / "png", snerg_folder(snerg()))
    assert run(["check", str(folder)]) == 0
    capsys.readouterr()
    # The file that says what the others hold stands for the folder.
    assert run(["info", str(folder / "scene_params.json"), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert (told["dialect"], told["resolution"]) == ("SNeRG", [11, 14, 8])
    assert told["colours"] == "RGB and a deferred MLP of 2x8"
    assert told["world_box"] == [[-1.25, -2.75, 1.25], [1.5, 0.75, 3.25]]
    lattice = load(folder, LatticeField)
    assert isinstance(lattice.colour, DeferredColour)


# -- what is refused -------------------------------------------------------------------------------------------
W, H = ATLAS[0], 4 * ATLAS[1]
LIES: dict[str, tuple[Lie, str]] = {
    "NDC": (changed(ndc=True), "scene_params.json has ndc: a forward-facing scene"),
    "MERF": (changed(triplane_resolution=2048), "scene_params.json has triplane_resolution: a key of MERF, whose"),
    "SMERF": (changed(scene_scale_factor=1), "has scene_scale_factor: a key of SMERF, a field of many MLPs"),
    "no JSON": (lambda made, files: files.update({"scene_params.json": b"["}), "scene_params.json cannot be parsed"),
    "another format": (changed(format="raw"), "scene_params.json: format is not supported; allowed: png"),
    "no block": (changed(block_size=0), "scene_params.json: block_size is 0; allowed: a whole number from 1 to 254"),
    "no width": (no_field("grid_width"), "scene_params.json: grid_width is missing"),
    "a huge grid": (changed(grid_depth=10**9), "scene_params.json: grid_depth is 1000000000"),
    "a small atlas": (changed(atlas_depth=4), "atlas_width, ... are (17, 10, 4); allowed: 5 or more, for a block"),
    "no voxels": (changed(voxel_size=0), "scene_params.json: voxel_size is 0"),
    "no place": (changed(min_y=None), "scene_params.json: min_y is missing"),
    "no turn": (no_field("worldspace_T_opengl"), "worldspace_T_opengl"),
    "a slanted turn": (changed(worldspace_T_opengl=[[0.8, 0.6, 0, 0], *TURN[1:]]), "is not a swap of axes; allowed: "),
    "an axis twice": (changed(worldspace_T_opengl=[TURN[1], *TURN[1:]]), "worldspace_T_opengl is not a swap of axes"),
    "ragged weights": (changed(_0_weights=[[1, 2], [3]]), "scene_params.json: 0_weights is not a table of numbers"),
    "no weights": (no_field("1_weights"), "scene_params.json: 1_weights"),
    "other inputs": (changed(_0_weights=np.ones((30, 8)).tolist()), "scene_params.json: 0_weights takes 30 inputs"),
    "other units": (changed(_1_weights=np.ones((8, 7)).tolist()), "scene_params.json: 1_weights has weights of (7, 8)"),
    "no biases": (changed(_2_bias=[]), "the MLP's last_bias has shape (0,)"),
    "no indices": (without("atlas_indices.png"), "atlas_indices.png is missing"),
    "no slice": (without("rgba_001.png"), "rgba_001.png is missing"),
    "no feature": (without("feature_002.png"), "feature_002.png is missing"),
    "other indices": (picture("atlas_indices.png", 9, 3, 3), "atlas_indices.png has 3x9 pixels of RGB; allowed: 3x8"),
    "a grey index": (picture("atlas_indices.png", 8, 3), "atlas_indices.png has 3x8 pixels of L"),
    "beyond the atlas": (picture("atlas_indices.png", 8, 3, 3, value=9),
                         "atlas_indices.png, block (0, 0, 0), points to (9, 9, 9); allowed: below (3, 2, 2)"),
    "twice": (picture("atlas_indices.png", 8, 3, 3), "atlas_indices.png points to a block of the atlas twice"),
    "nothing": (picture("atlas_indices.png", 8, 3, 3, value=255), "atlas_indices.png has no occupied block"),
    "other slices": (picture("rgba_000.png", H, W + 1, 4), f"rgba_000.png has {W + 1}x{H} pixels of RGBA"),
    "opaque slices": (picture("feature_000.png", H, W, 3), f"feature_000.png has {W}x{H} pixels of RGB"),
    "no picture": (lambda made, files: files.update({"rgba_000.png": b"x"}), "rgba_000.png cannot be read"),
    "half a picture": (half_of("rgba_000.png"), "rgba_000"),
}  # fmt: skip


@pytest.mark.parametrize("lie", LIES)
def test_a_lying_folder_is_refused(lie: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    change, expected = LIES[lie]
    made = snerg()
    files = snerg_folder(made)
    change(made, files)
    assert_refused(written(tmp_path / "bad", files), expected, capsys)


def test_blocks_are_cut_to_those_that_hold_something() -> None:
    made = snerg()
    made["indices"][:] = 255
    made["indices"][1, 1, 2] = (2, 1, 1)
    lattice = read(made)
    assert lattice.shape == (5, 5, 5)
    assert lattice.occupied is not None
    assert lattice.occupied.shape == (1, 1, 1)
    points = points_in(lattice, 50)
    assert_allclose(looked_up(lattice, points)[0], density_of(values_at(made, points)), rtol=1e-5, atol=1e-5)
    assert BLOCKS == (3, 2, 4)
