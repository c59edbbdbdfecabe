"""The real chair as other programs would have trained it: what becomes of its lattice, in decibels."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from nerfbake import LatticeField, N3Tree, build_octree, compare_scenes, load, octree_of_lattice, orbit_cameras
from nerfbake.kernels.march.sh import sh_basis
from nerfbake.kernels.maths.elementary import sigmoid
from nerfbake.kernels.maths.sphere import fibonacci
from nerfbake.scene.octree import SparseVoxelOctree
from tests.support.n3trees import archive
from tests.support.scenes import voxel_centres

pytestmark = [pytest.mark.data, pytest.mark.slow]
EDGE = 64


@pytest.fixture(scope="module")
def grid(chair: Path) -> SparseVoxelOctree:
    return build_octree(load(chair / "chair_sh9.npz", N3Tree), resolution=EDGE)


@pytest.fixture(scope="module")
def plenoxels(grid: SparseVoxelOctree, tmp_path_factory: pytest.TempPathFactory) -> LatticeField:
    """A checkpoint of svox2 with a node in each voxel that holds something, rows in no order: its colours are sums cut
    at 0 that are nearest to the chair's sigmoids."""
    values = grid.sample(grid.origin + voxel_centres(grid.size) * grid.voxel_size)
    held = np.flatnonzero(values[:, -1] > 0)
    basis = sh_basis(fibonacci(256), 9)
    seen = sigmoid(values[held, :-1].reshape(-1, 9) @ basis.T) - 0.5
    colours = (seen @ np.linalg.pinv(basis).T).reshape(-1, 27)
    order = np.random.default_rng(0).permutation(len(held))
    links = np.full(EDGE**3, -1, np.int32)
    links[held[order]] = np.arange(len(held))
    half = grid.voxel_size * EDGE / 2
    path = tmp_path_factory.mktemp("plenoxels") / "ckpt.npz"
    path.write_bytes(
        archive(
            {
                "radius": half.astype(np.float32),
                "center": (grid.origin + half).astype(np.float32),
                "links": links.reshape(EDGE, EDGE, EDGE),
                "density_data": values[held[order], -1:],
                "sh_data": colours[order].astype(np.float16),
                "basis_type": np.int64(1),
            },
            deflated=False,
        )
    )
    return load(path, LatticeField)


def decibels(lattice: LatticeField, other: SparseVoxelOctree) -> float:
    views = orbit_cameras(lattice, frames=5, width=160, height=160)
    return float(compare_scenes(lattice, other, views, keep_pictures=False).means["a_b"]["psnr"])


@pytest.mark.parametrize(("times", "least"), [(1, 33.0), (2, 42.0), (3, 48.0)])
def test_finer_voxels_are_nearer_to_the_lattices_own_pictures(
    times: int, least: float, plenoxels: LatticeField
) -> None:
    octree = octree_of_lattice(plenoxels, resolution=(times * EDGE,) * 3)
    assert decibels(plenoxels, octree) > least
