"""MERF's folders: the inner cube against its viewer's own lookups, deferred colours, and what is refused."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from nerfbake import Camera, LatticeField, build_octree_from_lattice, jobs, load, orbit_cameras, render_lattice
from nerfbake.cli.main import run
from nerfbake.errors import MemoryLimit
from nerfbake.formats.field import merf as reader
from nerfbake.jobs import readings
from nerfbake.kernels.lattice.harmonics import LEAST
from nerfbake.kernels.lattice.nodes import densities
from nerfbake.kernels.march.sh import sh_basis
from nerfbake.kernels.maths.elementary import fibonacci
from nerfbake.memory import memory_limit
from nerfbake.scene.lattice_field import DeferredColour
from nerfbake.stages import lattice_to_octree
from nerfbake.stages._lattice import MLP_DIRECTIONS, features_of, nodes_of, places_of, seen_along
from tests.jobs.listener import Listener
from tests.support.lies import Lie, assert_refused, changed, half_of, no_field, picture, without
from tests.support.merf import (
    ATLAS,
    PLANES,
    added,
    colour_at,
    density_of,
    merf,
    merf_folder,
    sums_at,
    values_of,
)
from tests.support.plenvdb import written
from tests.support.scenes import assert_same_octree, world_centres

RANDOM = np.random.default_rng(4)
BLOCKS_WIDE = 7


def read(made: dict[str, Any]) -> LatticeField:
    return reader.decode({name: memoryview(data) for name, data in merf_folder(made).items()})


@pytest.fixture(scope="module")
def made() -> dict[str, Any]:
    return merf()


@pytest.fixture(scope="module")
def lattice(made: dict[str, Any]) -> LatticeField:
    return read(made)


def points_in_cube(count: int) -> Any:
    """Anywhere, on its faces, and at its corners."""
    anywhere = RANDOM.uniform(-1, 1, (count, 3))
    on_faces = RANDOM.uniform(-1, 1, (60, 3))
    on_faces[np.arange(60), np.arange(60) % 3] = np.where(np.arange(60) < 30, -1, 1)
    return np.concatenate([anywhere, on_faces, list(product((-1.0, 1.0), repeat=3))])


@pytest.mark.parametrize("planes", [True, False])
def test_places_are_what_its_viewer_fetches_there(planes: bool) -> None:
    """Also where two blocks share a face and say different things of it."""
    made = merf(planes=planes)
    lattice = read(made)
    points = points_in_cube(900)
    held, sums = sums_at(made, points)
    places = places_of(lattice, points)
    expected = density_of(made, held, sums)
    assert_allclose(densities(nodes_of(lattice), places), expected, rtol=1e-5, atol=1e-5)
    assert 60 < np.count_nonzero(expected) <= np.count_nonzero(held) < len(points) / 2
    features = features_of(lattice)(places)[held]
    for ray, direction in enumerate(directions := fibonacci(3)):
        seen = seen_along(lattice, directions)(features, np.full(len(features), ray))
        assert_allclose(seen, colour_at(made, sums[held], direction), atol=1e-5)


def test_axes_stand_where_they_stand_in_its_viewer() -> None:
    """One block of its own in the grid: x falls along its first axis, z rises along the second, y along the third."""
    made = merf(planes=False)
    made["indices"][:] = 255
    made["indices"][1, 3, 4] = 0
    lattice = read(made)
    v = 4 / 21
    ends = -2 + v / 2 + v * 3 * np.array([[1, 4, 3], [2, 5, 4]])  # of x, mirrored; of y; of z
    low, high = [-ends[1, 0], *ends[0, 1:]], [-ends[0, 0], *ends[1, 1:]]
    assert_allclose(lattice.held_box, np.clip([low, high], -1, 1), atol=1e-12)


def test_outside_of_the_inner_cube_is_nothing(lattice: LatticeField) -> None:
    assert_array_equal(lattice.box, [[-1, -1, -1], [1, 1, 1]])
    (note,) = lattice.notes
    assert note.startswith("only MERF's inner cube, from -1 to 1 along each axis, is read")
    pose = np.eye(4)
    pose[:3, 3] = (0, 1.05, 3)
    assert not render_lattice(lattice, Camera(9, 1, 1e6, pose, "beside"), background=None).alpha.any()


def test_a_pictures_mlp_is_asked_once_for_each_ray() -> None:
    """Blocks of one kind: a ray's sums are its alpha times their values, and what is behind it."""
    made = merf()
    made["atlas"][:], made["planes"] = (
        (90, 140, 200, 160, 20, 60, 120, 180),
        [each * 0 + 100 for each in made["planes"]],
    )
    lattice = read(made)
    values = values_of(sums_at(made, world_of_a_block(made))[1])[0]
    camera = orbit_cameras(lattice, width=11, height=9).cameras[0]
    looks = camera.rays()[1]
    for background in ((1.0, 1.0, 1.0), (0.25, 0.5, 0.0)):
        image = render_lattice(lattice, camera, background=background, transmittance_cut=0)
        alpha = image.alpha.reshape(-1, 1).astype(float)
        assert (alpha == 0).any()
        assert ((alpha > 0.1) & (alpha < 0.9)).any()
        sums = alpha * values
        sums[:, :3] += (1 - alpha) * background
        expected = np.where(alpha > 0, np.minimum(sums[:, :3] + added(made, sums, looks), 1), background)
        assert_allclose(image.colour.reshape(-1, 3), expected, atol=1e-5)


def world_of_a_block(made: dict[str, Any]) -> Any:
    points = RANDOM.uniform(-1, 1, (200, 3))
    return points[sums_at(made, points)[0]][:1]


def test_empty_blocks_are_passed_over_and_nothing_else(lattice: LatticeField) -> None:
    """A grid that is all there, and dense nowhere else: the same pictures, step by step."""
    camera = orbit_cameras(lattice, width=16, height=12).cameras[0]
    image = render_lattice(lattice, camera, background=None)
    blocks, rows = lattice.blocks, lattice.n
    assert blocks is not None
    links = np.where(lattice.links < 0, rows, lattice.links).astype(np.int32)
    thin = np.full(blocks.rows, -1000, np.float32)
    features = np.concatenate([lattice.features, np.zeros((blocks.rows, 7), np.float32)])
    whole = replace(lattice, links=links, density=np.concatenate([lattice.density, thin]), features=features)
    assert_array_equal(render_lattice(whole, camera, background=None).colour, image.colour)


# -- octrees ---------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(("edge", "times"), [(14, 2), (5, 4)])
def test_voxels_are_means_of_samples(made: dict[str, Any], lattice: LatticeField, edge: int, times: int) -> None:
    octree = build_octree_from_lattice(lattice, resolution=(edge,) * 3)
    points = world_centres(octree)[::3]
    inside = (np.stack(np.meshgrid(*[np.arange(times)] * 3), -1).reshape(-1, 3) + 0.5) / times - 0.5
    near = (points[:, None] + inside * octree.voxel_size).reshape(-1, 3)
    held, sums = sums_at(made, near)
    density = density_of(made, held, sums)
    found = octree.sample(points)
    assert_allclose(found[:, -1], density.reshape(len(points), -1).mean(axis=1), rtol=1e-5, atol=1e-5)
    weight = (1 - np.exp(-density * octree.voxel_size[0] / times)).reshape(len(points), -1, 1)
    full = np.flatnonzero(weight.sum(axis=(1, 2)) > 0)[::9]
    means = (weight * values_of(sums).reshape(*weight.shape[:2], 7)).sum(axis=1)[full] / weight.sum(axis=1)[full]
    directions = fibonacci(MLP_DIRECTIONS)
    seen = np.stack([np.minimum(means[:, :3] + added(made, means, np.tile(d, (len(full), 1))), 1) for d in directions])
    cut = np.clip(seen, LEAST, 1 - LEAST).reshape(len(directions), -1)
    expected = np.linalg.lstsq(sh_basis(directions, 9), np.log(cut / (1 - cut)), rcond=None)[0].T
    assert_allclose(found[full, :-1], expected.reshape(len(full), 27), atol=2e-3)


def test_chunks_do_not_show(lattice: LatticeField, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = build_octree_from_lattice(lattice, basis="SH1", resolution=(7, 6, 5))
    monkeypatch.setattr(lattice_to_octree, "_TOGETHER", 2000)
    monkeypatch.setattr(lattice_to_octree, "_FITTED", 50)
    assert_same_octree(build_octree_from_lattice(lattice, basis="SH1", resolution=(7, 6, 5)), whole)


def test_as_many_voxels_as_fit_and_a_line_that_says_so(
    made: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(readings, "_EDGE", 16)
    folder = written(tmp_path / "baked", merf_folder(made))
    sizes, said = [], []
    for coarsest in (64, 4):
        monkeypatch.setattr(lattice_to_octree, "_COARSEST", coarsest)
        monkeypatch.setattr(lattice_to_octree, "_voxel_bytes", lambda B: 1 << 24)  # 256 voxels are all that fits
        steps = Listener()
        sizes.append(
            jobs.bake_octree(
                folder, tmp_path / f"{coarsest}.svo.npz", options=jobs.ReadingOptions(basis="SH1"), steps=steps
            ).size
        )
        said.append(steps.said)
    assert sizes == [(14, 14, 14), (7, 7, 7)]
    assert all("only MERF's inner cube" in note for note, *_ in said)
    assert re.search(r": in 14x14x14 voxels, [0-9.]+ dB against pictures of the lattice; colours differ", said[0][1])
    assert ": in 7x7x7 voxels (the finest that fit into memory; it has 14x14x14 cells), " in said[1][1]


def test_least_densities_make_no_voxels(lattice: LatticeField) -> None:
    every, dense = (build_octree_from_lattice(lattice, basis="SH1", sigma_min=least) for least in (None, 5.0))
    assert 0 < np.count_nonzero(dense.childless) < np.count_nonzero(every.childless)
    scaled = build_octree_from_lattice(lattice.scaled(2.0), basis="SH1")
    assert_allclose(scaled.sigma, every.sigma / 2, rtol=1e-6)
    assert_allclose(scaled.voxel_size, 2 * every.voxel_size)


# -- commands --------------------------------------------------------------------------------------------------
@pytest.mark.slow
def test_commands_take_it(made: dict[str, Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = written(tmp_path / "baked", merf_folder(made))
    for named in (folder, folder / "scene_params.json"):
        assert run(["check", str(named)]) == 0
        capsys.readouterr()
        assert run(["info", str(named), "--json"]) == 0
        told = json.loads(capsys.readouterr().out)
        assert (told["format"], told["dialect"], told["resolution"]) == ("merf", "MERF", [14, 14, 14])
        assert told["colours"] == "RGB and a deferred MLP of 2x8"
        assert (told["blocks"], told["held_blocks"], told["planes"]) == ([5, 5, 5], 22, 15)
    lattice = load(folder, LatticeField)
    assert isinstance(lattice.colour, DeferredColour)
    small = ["--size", "16x16", "-q"]
    shown = str(tmp_path / "a.svo.pb")
    assert run(["convert", str(folder), shown, "-q"]) == 0
    assert run(["vdb", str(folder), str(tmp_path / "a.vdb"), "--resolution", "7", "-q"]) == 0
    assert run(["render", str(folder), "--out", str(tmp_path / "a.png"), *small]) == 0
    assert run(["compare", str(folder), shown, *small]) == 0
    assert run(["view", str(folder), str(tmp_path / "a.html"), "--data", "exact", "-q"]) == 0


# -- what is refused -------------------------------------------------------------------------------------------
W, H, D = ATLAS
INDICES = BLOCKS_WIDE**2, BLOCKS_WIDE
LIES: dict[str, tuple[Lie, str]] = {
    "SMERF": (changed(submodel_idx=0), "scene_params.json has submodel_idx: a key of SMERF, a field of many MLPs"),
    "torch-merf": (changed(triplane_voxel_size=2 / PLANES),
                   "triplane_voxel_size is 0.0740741: another world size than MERF's, as in torch-merf"),
    "planes alone": (changed(sparse_grid_resolution=-1), "scene_params.json has no sparse grid, whose blocks define"),
    "no parameters": (without("scene_params.json"), "scene_params.json is missing"),
    "no JSON": (lambda made, files: files.update({"scene_params.json": b"["}), "scene_params.json cannot be parsed"),
    "a huge grid": (changed(sparse_grid_resolution=10**9), "scene_params.json: sparse_grid_resolution is 1000000000"),
    "a large grid": (changed(sparse_grid_resolution=16384, sparse_grid_voxel_size=4 / 16384),
                     "sparse_grid_block_indices.png has 7x49 pixels of RGB; allowed: 5462x29833444 of RGB"),
    "huge planes": (changed(triplane_resolution=16384, triplane_voxel_size=4 / 16384),
                    "the planes needs 6.0 GiB in addition to"),
    "three nodes": (changed(triplane_resolution=3), "scene_params.json: triplane_resolution is 3; allowed: 4 to"),
    "no spacing": (no_field("sparse_grid_voxel_size"), "scene_params.json: sparse_grid_voxel_size is missing"),
    "no block": (changed(data_block_size=0), "data_block_size is 0; allowed: a whole number from 1 to 254"),
    "thick slices": (changed(slice_depth=2), "scene_params.json: slice_depth is 2"),
    "a huge atlas": (changed(atlas_width=10**9), "scene_params.json: atlas_width is 1000000000"),
    "a small atlas": (changed(atlas_depth=3), "atlas_width, ... are (17, 14, 3); allowed: 4 or more, for a block"),
    "no range": (no_field("range_density"), "scene_params.json: range_density"),
    "an odd range": (changed(range_features=[1, 2, 3]), "scene_params.json: range_features has shape (3,)"),
    "a falling range": (changed(range_features=[7, -7]), "range_features is 7 to -7; allowed: two increasing"),
    "a huge range": (changed(range_density=[0, 400]), "range_density is 0 to 400; allowed: two increasing numbers, -2"),
    "no numbers": (lambda made, files: files.update({"scene_params.json": json.dumps(
        made["fields"] | {"range_density": [float("nan"), 1]}).encode()}), "range_density[0] is NaN; allowed"),
    "infinite": (lambda made, files: files.update({"scene_params.json": json.dumps(
        made["fields"] | {"range_density": [0, 1e300]}).encode()}), "range_density[1] is 1e+300"),
    "ragged weights": (changed(_0_weights=[[1, 2], [3]]), "scene_params.json: 0_weights is not a table of numbers"),
    "huge weights": (changed(_2_weights=np.full((8, 3), 1e15).tolist()),
                     "2_weights has a number as large as 1e+15; allowed: up to 1e+06"),
    "no weights": (no_field("1_weights"), "scene_params.json: 1_weights"),
    "other inputs": (changed(_0_weights=np.ones((30, 8)).tolist()), "scene_params.json: 0_weights takes 30 inputs"),
    "no indices": (without("sparse_grid_block_indices.png"), "sparse_grid_block_indices.png is missing"),
    "no slice": (without("sparse_grid_rgb_and_density_005.png"), "sparse_grid_rgb_and_density_005.png is missing"),
    "no features": (without("sparse_grid_features_000.png"), "sparse_grid_features_000.png is missing"),
    "no plane": (without("plane_features_2.png"), "plane_features_2.png is missing"),
    "other indices": (picture("sparse_grid_block_indices.png", 48, 7, 3),
                      "sparse_grid_block_indices.png has 7x48 pixels of RGB; allowed: 7x49 of RGB"),
    "grey indices": (picture("sparse_grid_block_indices.png", *INDICES), "has 7x49 pixels of L"),
    "beyond the atlas": (picture("sparse_grid_block_indices.png", *INDICES, 3, value=4),
                         "block (0, 0, 0), points to (4, 4, 4); allowed: below (4, 3, 2), the block counts of"),
    "twice": (picture("sparse_grid_block_indices.png", *INDICES, 3), "points to a block of the atlas twice"),
    "nothing": (picture("sparse_grid_block_indices.png", *INDICES, 3, value=255),
                "has no occupied block in the inner cube"),
    "other slices": (picture("sparse_grid_features_001.png", H, W + 1, 4),
                     f"sparse_grid_features_001.png has {W + 1}x{H} pixels of RGBA; allowed: {W}x{H} of RGBA"),
    "opaque planes": (picture("plane_rgb_and_density_1.png", PLANES, PLANES, 3), "has 27x27 pixels of RGB"),
    "no picture": (lambda made, files: files.update({"plane_features_0.png": b"x"}), "plane_features_0.png cannot be"),
    "half a picture": (half_of("sparse_grid_features_003.png"), "sparse_grid_features_003.png"),
}  # fmt: skip


@pytest.mark.parametrize("lie", LIES)
def test_a_lying_folder_is_refused(lie: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    change, expected = LIES[lie]
    made = merf()
    files = merf_folder(made)
    change(made, files)
    assert_refused(written(tmp_path / "bad", files), expected, capsys)


def test_a_folder_takes_no_more_memory_than_there_is(made: dict[str, Any]) -> None:
    with memory_limit(1 << 16), pytest.raises(MemoryLimit, match="the nodes"):
        read(made)
