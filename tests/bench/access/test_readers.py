from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

from nerfbake import build_vdb
from nerfbake.bench.access.comparison import KINDS
from nerfbake.bench.access.readers import reading, structure_named
from nerfbake.errors import NerfbakeError
from nerfbake.scene.octree import SparseVoxelOctree

OURS = ("dense array", "dense pointers", "octree", "VDB", "VDB index")
NANOVDB = ("NanoVDB C++", "NanoVDB C++, no stencil cache")


@pytest.mark.parametrize("channels", [1, 13])
@pytest.mark.parametrize("name", OURS)
def test_every_structure_reads_what_the_grid_reads(
    name: str, channels: int, folder: Path, octree: SparseVoxelOctree
) -> None:
    grid = build_vdb(octree, grids=("index",)).grids[0]
    for kind in KINDS:
        points = np.fromfile(folder / f"{kind}.f32", np.float32).reshape(-1, 3).astype(np.float64)
        structure = structure_named(name, folder, channels, 1 << 30)
        out = np.empty((len(points), channels), np.float32)
        structure.read(*structure.arrays, points, out)
        assert_allclose(out, grid.sample(points, lookup="trilinear")[:, -channels:], rtol=1e-5, atol=1e-3)
        assert np.count_nonzero(out) > len(points) / 50


@pytest.mark.slow
def test_warp_reads_the_same(folder: Path) -> None:
    assert _sums("Warp", folder) == pytest.approx(_sums("VDB", folder), rel=1e-5)


@pytest.mark.tools
@pytest.mark.slow
def test_nanovdb_reads_the_same(folder: Path) -> None:
    if (missing := folder / "nanovdb.missing").exists() and "(Debian: " in missing.read_text():
        pytest.skip(f"{missing.read_text()}: `make tools` installs it")
    for name in NANOVDB:
        assert _sums(name, folder) == pytest.approx(_sums("VDB", folder), rel=1e-5)


def _sums(name: str, folder: Path) -> list[float]:
    work = reading(name, str(folder), 1, list(KINDS), 1 << 30)
    return [found[1] for found in work.check(work.run())["found"]]


def test_openvdb_keeps_its_row() -> None:
    with pytest.raises(NerfbakeError, match=r"2.5 microseconds each"):
        reading("OpenVDB C++", "", 1, [], 0)
