"""A lattice as voxels: against formulas that hold between the nodes, and against a picture of the lattice itself."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from nerfbake import (
    LatticeField,
    SparseVoxelOctree,
    build_octree_from_lattice,
    compare_scenes,
    measure_lattice,
    orbit_cameras,
)
from nerfbake.errors import InvalidScene, MemoryLimit
from nerfbake.formats.field import svox2 as reader
from nerfbake.memory import memory_limit
from nerfbake.scene.lattice_field import Activation
from nerfbake.stages import lattice_to_octree
from tests.support.lattices import RGB, SHAPE, Y0, affine, some_lattice, svox2, svox2_file
from tests.support.scenes import assert_same_octree, world_centres


def read(**fields: object) -> LatticeField:
    return reader.decode(memoryview(svox2_file(svox2(**fields))))  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def octree() -> SparseVoxelOctree:
    return build_octree_from_lattice(read())


@pytest.mark.long
def test_voxels_are_twice_as_fine_and_hold_what_is_between_the_nodes(octree: SparseVoxelOctree) -> None:
    lattice = read()
    assert octree.size == tuple(2 * edge for edge in SHAPE)
    points = world_centres(octree)
    low, high = lattice.box + np.array([[1], [-1]]) * lattice.spacing / 2
    # Half a cell before the end the border's value goes on.
    assert_allclose(octree.sample(points)[:, -1], np.maximum(affine(np.clip(points, low, high)), 0), atol=1e-5)


def test_a_colour_of_one_coefficient_is_one_of_the_sigmoid(octree: SparseVoxelOctree) -> None:
    colour = 0.5 + Y0 * np.array(RGB)
    expected = np.zeros(27)
    expected[::9] = np.log(colour / (1 - colour)) / Y0
    held = octree.childless
    assert_allclose(octree.node_data[held, :-1], np.broadcast_to(expected, (held.sum(), 27)), atol=1e-5)


def test_only_densities_above_0_are_voxels() -> None:
    raw = np.where(np.arange(np.prod(SHAPE)) % 3 == 0, 5.0, -4.0)
    octree = build_octree_from_lattice(read(raw=raw, empty=0.4), basis="SH1")
    octree.require_usable()
    assert (octree.sigma > 0).all()


def test_chunks_do_not_show(monkeypatch: pytest.MonkeyPatch) -> None:
    lattice = read(plain=False, empty=0.5)
    whole = build_octree_from_lattice(lattice, basis="SH4")
    monkeypatch.setattr(lattice_to_octree, "_TESTED", 1)
    monkeypatch.setattr(lattice_to_octree, "_FITTED", 7)
    assert_same_octree(build_octree_from_lattice(lattice, basis="SH4"), whole)


def test_a_lattice_of_wide_planes_takes_no_more_memory_for_it() -> None:
    """A file of 33 KB with 2 x 2048 x 2048 links took 1.1 GB under --max-memory 256MiB."""
    lattice = some_lattice()
    links, features = np.zeros((2, 512, 1024), np.int32), lattice.features[:1]
    lattice = replace(lattice, links=links, density=np.zeros(1, np.float32), features=features, occupied=None)
    tracemalloc.start()
    with pytest.raises(InvalidScene, match="is empty"):
        build_octree_from_lattice(lattice)
    assert tracemalloc.get_traced_memory()[1] < 40 << 20  # of 2 million voxels a plane
    tracemalloc.stop()


def test_densities_of_nodes_at_corners_are_activated_between_them() -> None:
    mask = np.zeros((3, 3, 3), bool)
    mask[1:] = True
    lattice = some_lattice(at_corners=True, activation=Activation("softplus", -9.0, 3.0), occupied=mask, least=0.01)
    octree = build_octree_from_lattice(lattice, basis="SH1")
    assert octree.size == (8, 10, 12)
    points = world_centres(octree)
    density = 3 * np.logaddexp(0, affine(points) - 9)
    density[1 - np.exp(-density * lattice.step) <= 0.01] = 0
    inside = (points - lattice.box[0]) / (lattice.box[1] - lattice.box[0])
    density[inside[:, 0] < 0.25] = 0
    assert_allclose(octree.sample(points)[:, -1], density, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("resolution", [SHAPE, (2, 3, 3)])
def test_coarse_voxels_are_means_of_finer_ones(resolution: tuple[int, int, int]) -> None:
    """The raw density is affine: so is its mean, where none is 0."""
    octree = build_octree_from_lattice(some_lattice(at_corners=True), resolution=resolution, basis="SH1")
    assert octree.size == resolution
    assert_allclose(octree.sample(world_centres(octree))[:, -1], affine(world_centres(octree)), rtol=1e-5)


def test_options_reach_the_octree() -> None:
    octree = build_octree_from_lattice(some_lattice(), basis="SH16", dtype="float16", layout="compact", sigma_min=12.0)
    assert (octree.data_format, octree.layout) == ("SH16", "compact")
    assert octree.node_data.dtype == np.float16
    assert octree.sigma[octree.childless].min() >= 12
    assert_array_equal(octree.node_data[:, 1:16], 0)  # the same in every direction


def test_a_scaled_world_looks_the_same() -> None:
    lattice = some_lattice()
    octree, large = (build_octree_from_lattice(each, basis="SH1") for each in (lattice, lattice.scaled(4.0)))
    assert_array_equal(large.node_children, octree.node_children)
    assert_allclose(large.sigma, octree.sigma / 4, rtol=1e-6)
    assert_allclose(large.voxel_size, 4 * octree.voxel_size)


def test_what_cannot_be_is_refused() -> None:
    with pytest.raises(InvalidScene, match="is empty"):
        build_octree_from_lattice(some_lattice(raw=-1.0))
    with pytest.raises(InvalidScene, match="basis is RGBA"):
        build_octree_from_lattice(some_lattice(), basis="RGBA")
    with pytest.raises(InvalidScene, match="1 to 4096 voxels"):
        build_octree_from_lattice(some_lattice(), resolution=(4097, 1, 1))
    with pytest.raises(InvalidScene, match="float16"):
        build_octree_from_lattice(some_lattice(raw=1e6), dtype="float16")
    with memory_limit(1 << 17), pytest.raises(MemoryLimit):
        build_octree_from_lattice(some_lattice(), resolution=(64, 64, 64))


# -- what it loses ---------------------------------------------------------------------------------------------
def test_more_coefficients_lose_less() -> None:
    lattice = read(plain=False)
    lost = [
        measure_lattice(lattice, build_octree_from_lattice(lattice, basis=basis))
        for basis in ("SH1", "SH4", "SH9", "SH16")
    ]
    assert lost == sorted(lost, reverse=True)
    assert lost[3] < lost[2] / 1.2
    flat = some_lattice()
    assert measure_lattice(flat, build_octree_from_lattice(flat)) < 1e-3


def test_the_loss_is_told_in_steps_of_a_byte() -> None:
    lattice = some_lattice()
    octree = build_octree_from_lattice(replace(lattice, features=np.zeros_like(lattice.features)))
    grey = replace(lattice, features=np.full_like(lattice.features, np.log(0.6 / 0.4)))
    assert measure_lattice(grey, octree) == pytest.approx(255 * 0.1, rel=1e-5)


def test_finer_voxels_look_more_like_the_lattice() -> None:
    bump = some_lattice()
    u = np.stack(np.meshgrid(*((np.arange(e) + 0.5) / e - 0.5 for e in SHAPE), indexing="ij"), -1)
    raw = 60 * (0.1 - (u**2).sum(-1)).reshape(-1)
    bump = replace(bump, density=raw.astype(np.float32))
    views = orbit_cameras(bump, width=48, height=48)
    psnr = []
    for times in (2, 4):
        octree = build_octree_from_lattice(bump, resolution=tuple(times * e for e in SHAPE), basis="SH1")  # type: ignore[arg-type]
        psnr.append(compare_scenes(bump, octree, views).means["a_b"]["psnr"])
    assert psnr[0] > 30
    assert psnr[1] > psnr[0] + 3
