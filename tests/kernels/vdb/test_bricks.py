from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from nerfbake.kernels.vdb import bricks
from nerfbake.kernels.vdb.bitmask import popcount, slots_of
from nerfbake.kernels.vdb.bricks import Bricks, bricks_of
from nerfbake.scene.octree import SparseVoxelOctree
from tests.support.scenes import world_centres


def random_octree(size: tuple[int, int, int], seed: int, *, splits: float) -> SparseVoxelOctree:
    """Nodes that split by chance down to single voxels; each holds its own number."""
    random = np.random.default_rng(seed)
    rows, count, level = [], 1, 1
    for depth in range(max(edge - 1 for edge in size).bit_length()):
        split = random.random(level) < (1 if depth == 0 else splits)
        there = split[:, None] & (random.random((level, 8)) < 0.8)
        table = np.zeros((level, 8), np.int32)
        table[there] = np.arange(count, count + int(there.sum()))
        rows.append(table)
        level = int(there.sum())
        count += level
    rows.append(np.zeros((level, 8), np.int32))
    children = np.concatenate(rows)
    return SparseVoxelOctree(size, children, np.arange(1, 1 + count, dtype=np.float32)[:, None])


def voxels(made: Bricks, size: tuple[int, int, int]) -> np.ndarray[tuple[int, ...], np.dtype[np.int64]]:
    """W x H x D, the node in each voxel or -1."""
    row, slot = slots_of(made.mask)
    x, y, z = (made.low[row, axis] + (slot >> 6 - 3 * axis & 7) for axis in range(3))
    dense = np.full(size, -1, np.int64)
    dense[x, y, z] = made.node
    return dense


@pytest.mark.parametrize("chunk", [1, 3, 512])
@pytest.mark.parametrize(
    ("size", "splits"),
    [
        ((1, 1, 1), 1.0),
        ((3, 2, 1), 0.9),
        ((8, 8, 8), 0.7),
        ((9, 30, 17), 0.8),
        ((64, 64, 64), 0.5),
        ((64, 40, 50), 0.3),
        ((100, 1, 33), 0.5),
    ],
)
def test_every_voxel_has_the_leaf_that_the_octree_says(
    size: tuple[int, int, int], splits: float, chunk: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bricks, "_CHUNK", chunk)
    monkeypatch.setattr(bricks, "_ROWS", 50 * chunk)
    monkeypatch.setattr(bricks, "_FEW", 1 << 22 if chunk > 1 else 0)  # or numbers of 64 bits
    edges = set()
    for seed in range(6):
        octree = random_octree(size, seed, splits=splits)
        filled = octree.childless & (np.random.default_rng(seed).random(octree.n) < 0.9)
        made = bricks_of(octree.node_children, octree.level_sizes, filled, size)
        node = octree.sample(world_centres(octree)).reshape(size).astype(np.int64) - 1
        assert_array_equal(voxels(made, size), np.where(filled[node], node, -1))
        assert len(np.unique(made.low, axis=0)) == len(made.low)
        assert popcount(made.mask).sum() == len(made.node) == np.count_nonzero(voxels(made, size) >= 0)
        edges |= {edge for edge, level in zip(_edges(octree), _filled(octree, filled), strict=True) if level}
    if size == (64, 64, 64):
        assert edges >= {1, 2, 4, 8, 16, 32}  # leaves within a brick, as a brick, and as many


def _edges(octree: SparseVoxelOctree) -> list[int]:
    return [1 << octree.grid_level - level for level in range(len(octree.level_sizes))]


def _filled(octree: SparseVoxelOctree, filled: np.ndarray[tuple[int], np.dtype[np.bool_]]) -> list[bool]:
    ends = np.cumsum(octree.level_sizes)[:-1]
    return [bool(part.any()) for part in np.split(filled, ends)]
