from __future__ import annotations

from pathlib import Path

import pytest

from nerfbake import build_octree, build_vdb, sample_n3tree
from nerfbake.bench.access.readers import write_inputs
from nerfbake.scene.octree import SparseVoxelOctree

POINTS = 3000


@pytest.fixture(scope="session")
def octree() -> SparseVoxelOctree:
    """Leaves of several sizes, and edges that are no power of two."""
    return build_octree(sample_n3tree(resolution=32, basis="SH4", seed=3), resolution=(32, 20, 27))


@pytest.fixture(scope="session")
def folder(octree: SparseVoxelOctree, tmp_path_factory: pytest.TempPathFactory) -> Path:
    home = tmp_path_factory.mktemp("access")
    density, index = (build_vdb(octree, grids=(grid,)) for grid in ("density", "index"))
    write_inputs(home, octree, density, index, POINTS)
    return home
