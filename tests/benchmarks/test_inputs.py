"""What other programs would have trained of an octree: the same densities at the nodes, and colours near its own."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

from benchmarks.inputs import FEATURES, WIDTH, write_plenoxels, write_voxels
from nerfbake import LatticeField, build_octree, load, sample_n3tree
from nerfbake.kernels.lattice.nodes import densities
from nerfbake.kernels.march.sh import sh_basis
from nerfbake.kernels.maths.elementary import fibonacci, sigmoid
from nerfbake.scene.octree import SparseVoxelOctree
from nerfbake.stages._lattice import nodes_of, seen_along, table_of

EDGE = 6


@pytest.fixture(scope="module")
def octree() -> SparseVoxelOctree:
    return build_octree(sample_n3tree(resolution=16, basis="SH4"))


def node_places(lattice: LatticeField) -> np.ndarray:
    """(n, 3) shares of the box."""
    shares = np.linspace(0, 1, EDGE) if lattice.at_corners else (np.arange(EDGE) + 0.5) / EDGE
    return np.stack(np.meshgrid(shares, shares, shares, indexing="ij"), -1).reshape(-1, 3)


@pytest.mark.parametrize("name", ["ckpt.npz", "fine_last.tar"])
def test_nodes_hold_the_octrees_values(name: str, octree: SparseVoxelOctree, tmp_path: Path) -> None:
    if name == "ckpt.npz":
        write_plenoxels(tmp_path / name, octree, EDGE)
    else:
        write_voxels(tmp_path / name, octree, EDGE, steps=60)
    lattice = load(tmp_path / name, LatticeField)
    places = node_places(lattice)
    inner = np.minimum(places, 1 - 1e-9) * (octree.voxel_size * octree.size)
    values = octree.sample(octree.origin + inner)
    assert_allclose(densities(nodes_of(lattice), places), values[:, -1], rtol=1e-4, atol=1e-2)
    held = values[:, -1] > 0
    features, direction = table_of(lattice)[lattice.links.reshape(-1)[held]], fibonacci(5)[2:3]
    seen = seen_along(lattice, direction)(features, np.zeros(len(features), np.int64))
    truth = sigmoid(values[held, :-1].reshape(-1, 3, 4) @ sh_basis(direction, 4)[0])
    assert np.abs(seen - truth).mean() < 0.08
    assert str(lattice.colour) in ("SH4, cut at 0", f"MLP of 2x{WIDTH}")
    assert lattice.features.shape[1] in (12, FEATURES)
