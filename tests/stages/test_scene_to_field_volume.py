from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

from nerfbake import (
    Camera,
    SparseVoxelOctree,
    build_field,
    build_octree,
    build_vdb,
    orbit_cameras,
    render_field,
)
from nerfbake.errors import InvalidScene, MemoryLimit
from nerfbake.memory import memory_limit
from nerfbake.scene.camera import look_at
from nerfbake.scene.vdb import VdbTree
from nerfbake.scene.vdb_topology import topology_of
from nerfbake.scene.volume import Volume
from tests.support.scenes import n3tree


def grown(data_format: str = "SH4") -> SparseVoxelOctree:
    """An octree with leaves at three levels and empty space, around the world's origin."""
    tree = n3tree(splits=[(0, (1, 0, 1)), (1, (1, 1, 1))], data_format=data_format, dtype=np.float32)
    tree.data[0, 0, 0, :, -1] = 0
    octree = build_octree(tree, resample="nearest")
    return dataclasses.replace(octree, origin=np.full(3, -0.5), voxel_size=octree.voxel_size * [1, 2, 1])


@pytest.mark.parametrize("lookup", ["nearest", "trilinear"])
@pytest.mark.parametrize("grids", [("index",), ("density", "sh")])
def test_a_volume_looks_like_the_octree_it_was_made_from(grids: tuple[str, ...], lookup: Any) -> None:
    octree = grown()
    for up in ("z", "y"):
        fields = build_field(octree), build_field(build_vdb(octree, grids=grids, up=up))
        views = [orbit_cameras(field, width=24, height=20).cameras[0] for field in fields]
        one, other = (render_field(field, view, lookup=lookup) for field, view in zip(fields, views, strict=True))
        assert one.alpha.max() > 0.1
        assert_allclose(one.colour, other.colour, atol=2e-4)
        assert_allclose(one.depth, other.depth, atol=2e-3)


def test_a_volume_without_coefficients_shows_its_colour_or_grey() -> None:
    octree, camera = grown("SH1"), orbit_cameras(build_field(grown()), width=24, height=20).cameras[0]
    image = render_field(build_field(octree), camera)
    assert_allclose(render_field(build_field(build_vdb(octree)), camera).colour, image.colour, atol=2e-4)
    grey = render_field(build_field(build_vdb(octree, grids=("density",))), camera, background=(0.5, 0.5, 0.5))
    assert_allclose(grey.colour, 0.5, atol=1e-6)
    assert_allclose(grey.alpha, image.alpha, atol=2e-4)
    with pytest.raises(InvalidScene, match="the volume has the grids Cd; allowed: density among them, or index"):
        build_field(build_vdb(octree, grids=("Cd",)))


def test_colours_of_other_voxels_are_looked_up() -> None:
    # Another program may have pruned one grid and not the other.
    octree, camera = grown("SH1"), orbit_cameras(build_field(grown()), width=24, height=20).cameras[0]
    density, colour = build_vdb(octree).grids
    more = np.concatenate([colour.topology.coords, [[40, 3, 5]]])
    topology, order = topology_of(more)
    values = np.concatenate([colour.values, [[0.1, 0.2, 0.3]]]).astype(np.float32)[order]
    assert isinstance(colour, VdbTree)
    other = dataclasses.replace(colour, topology=topology, values=values)
    pruned = Volume((density, other), build_vdb(octree).transform)
    one, expected = (render_field(build_field(scene), camera).colour for scene in (pruned, octree))
    assert_allclose(one, expected, atol=2e-4)


def test_more_cells_than_memory_has_are_refused() -> None:
    volume = build_vdb(grown())
    with memory_limit(100_000), pytest.raises(MemoryLimit, match=r"the volume as cells needs 146.0 KiB; allowed: 97.7"):
        build_field(volume)


@pytest.mark.parametrize("far", [4096, -8192, 1 << 30, -(1 << 31)])
def test_voxels_anywhere_in_32_bits_are_seen(far: int) -> None:
    coords = np.array([[0, 0, 0], [1, 0, 0], [0, far, 0]], np.int64)
    topology, _ = topology_of(coords)
    density = VdbTree("density", topology, np.full((3, 1), 50, np.float32), np.zeros(1, np.float32))
    field = build_field(Volume((density,), np.eye(4)[:3]))
    for voxel in ([0, 0, 0], [0, far, 0]):
        # Its face seen from 2 away, along x; the voxel's sample stands at its centre.
        camera = Camera(1, 1, 1e4, look_at(np.array(voxel, float), np.pi, 0, 2.5))
        image = render_field(field, camera)
        assert_allclose(image.alpha, 1, atol=1e-6)
        assert_allclose(image.depth, 2.0, atol=0.05)


# -- the real chair --------------------------------------------------------------------------------------------
