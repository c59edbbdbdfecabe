from __future__ import annotations

import numpy as np
import pytest

from nerfbake import build_vdb
from nerfbake.bench.access.comparison import KINDS
from nerfbake.bench.access.readers import kinds_of_points
from nerfbake.scene.octree import SparseVoxelOctree
from tests.bench.access.conftest import POINTS


def test_points_are_where_their_kind_says(octree: SparseVoxelOctree) -> None:
    topology = build_vdb(octree, grids=("density",)).grids[0].topology
    assert topology.box is not None
    kinds = kinds_of_points(octree.size, topology, POINTS)
    assert tuple(kinds) == KINDS
    assert all(len(points) in (POINTS, POINTS // 800 * 800) and points.dtype == np.float32 for points in kinds.values())
    active = {tuple(voxel) for voxel in topology.coords.tolist()}
    assert all(tuple(voxel) in active for voxel in np.floor(kinds["surface"] + 0.4999).astype(int).tolist())
    assert (kinds["rays"] >= topology.box[0] - 0.51).all()
    assert (kinds["rays"] <= topology.box[1] + 0.51).all()
    steps = np.linalg.norm(np.diff(kinds["rays"], axis=0), axis=1)
    assert np.median(steps) == pytest.approx(0.5, rel=1e-4)
    again = kinds_of_points(octree.size, topology, POINTS)
    assert all((again[kind] == kinds[kind]).all() for kind in kinds)
