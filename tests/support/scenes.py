"""Scenes that are small enough to check by hand, and Hypothesis strategies for random scenes."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from hypothesis import strategies as st

from nerfbake.scene.basis import parse_basis
from nerfbake.scene.n3tree import N3Tree
from nerfbake.scene.octree import SparseVoxelOctree

Cell = tuple[int, int, int]


def n3tree(
    splits: list[tuple[int, Cell]] | None = None,
    *,
    N: int = 2,
    data_format: str = "SH1",
    dtype: Any = np.float16,
    **fields: Any,
) -> N3Tree:
    """A PlenOctree with node 0 as root. Each split (node, cell) makes the next node a child of that cell.

    All cells have different values: sigma is 1 + cell index / 8. So no cells merge, and none is empty.
    """
    n = 1 + len(splits or [])
    child = np.zeros((n, N, N, N), np.int32)
    for new, (node, cell) in enumerate(splits or [], start=1):
        child[(node, *cell)] = new - node
    dim = parse_basis(data_format).data_dim
    number = np.arange(n * N**3, dtype=np.float64).reshape(n, N, N, N, 1)
    data = (1 + number / 8 + np.arange(dim) / 64)[..., ::-1].astype(dtype)
    fields = {"offset": np.zeros(3), "invradius": np.ones(3)} | fields
    return N3Tree(child=child, data=fields.pop("data", data), data_format=data_format, **fields)


@st.composite
def n3trees(draw: st.DrawFn, *, max_nodes: int = 8, dtypes: Any = (np.float16, np.float32)) -> N3Tree:
    """Random trees: N = 2 or 3, leaves on several levels, empty leaves, equal neighbours, freed rows, stale cells."""
    N = draw(st.sampled_from([2, 2, 2, 3]))
    data_format = draw(st.sampled_from(["SH1", "SH4", "RGBA", "SG2", "ASG2"]))
    count = draw(st.integers(1, max_nodes))
    random = np.random.default_rng(draw(st.integers(0, 2**32)))
    freed = draw(st.integers(0, 2))
    n = count + freed
    rows = np.sort(random.permutation(np.arange(1, n))[: count - 1]) if n > 1 else np.zeros(0, int)
    child = np.full((n, N, N, N), -1, np.int32)
    child[0] = 0
    live = [0]
    for row in rows:
        child[row] = 0
        # A random free cell of a random node above, at most two levels deep.
        free = [i for i in live if _depth(child, i) < 2 and (child[i] == 0).any()]
        parent = int(random.choice(free))
        cell = random.choice(np.flatnonzero(child[parent].ravel() == 0))
        child[parent].ravel()[cell] = row - parent
        live.append(int(row))
    dim = parse_basis(data_format).data_dim
    dtype = draw(st.sampled_from(dtypes))
    palette = random.normal(0, 2, (4, dim)).astype(dtype)
    palette[:, -1] = [0, 0.25, 3, 40]
    if draw(st.booleans()):
        data = palette[random.integers(0, 4, (n, N, N, N))]
    else:
        data = random.normal(0, 1, (n, N, N, N, dim)).astype(dtype)
        data[..., -1] = np.maximum(random.normal(0, 5, (n, N, N, N)), 0).astype(dtype)
    # Values of inner cells and freed rows must not be read.
    data[child != 0] = np.nan
    lobes = random.normal(0, 1, (2, 4 if data_format == "SG2" else 11)).astype(np.float32)
    return N3Tree(
        child=child,
        data=data,
        offset=random.normal(0.5, 0.1, 3),
        invradius=random.uniform(0.2, 2, 3),
        data_format=data_format,
        extra_data=lobes if data_format.endswith("G2") else None,
    )


def _depth(child: npt.NDArray[np.int32], row: int) -> int:
    depth = 0
    while row:
        parents = [i for i in range(row) if (child[i] == row - i).any()]
        row, depth = parents[0], depth + 1
    return depth


sizes = st.one_of(
    st.sampled_from([1, 2, 3, 4, 6, 8, 9]).map(lambda edge: (edge, edge, edge)),
    st.tuples(st.integers(1, 9), st.integers(1, 9), st.integers(1, 9)),
)


@st.composite
def octrees(draw: st.DrawFn, *, dtypes: Any = (np.float32, np.float16)) -> SparseVoxelOctree:
    """Octrees with random topology, layout, dtype and finite values."""
    size = draw(sizes)
    height = max(edge - 1 for edge in size).bit_length()
    random = np.random.default_rng(draw(st.integers(0, 2**32)))
    table: list[npt.NDArray[np.int32]] = []
    level, n = 1, 1
    for _ in range(height):
        children = random.random((level, 8)) < draw(st.sampled_from([0.0, 0.2, 0.6]))
        numbers = np.zeros((level, 8), np.int32)
        numbers[children] = np.arange(n, n + children.sum())
        table.append(numbers)
        level = int(children.sum())
        n += level
        if not level or n > 300:
            break
    table.append(np.zeros((level, 8), np.int32))
    data_format = draw(st.sampled_from(["SH1", "RGBA", "SH9", "SG2", ""]))
    dim = parse_basis(data_format).data_dim if data_format else 6
    dtype = draw(st.sampled_from(dtypes))
    octree = SparseVoxelOctree(
        size=size,
        node_children=np.concatenate(table)[:n],
        node_data=np.abs(random.normal(0, 9, (n, dim))).astype(dtype),
        data_format=data_format,
        origin=random.normal(0, 1, 3),
        voxel_size=random.uniform(0.01, 2, 3),
        extra_data=random.normal(0, 1, (2, 4)).astype(np.float32) if data_format == "SG2" else None,
    )
    return octree.with_layout(draw(st.sampled_from(["full", "compact"])))


def assert_same_octree(a: SparseVoxelOctree, b: SparseVoxelOctree) -> None:
    """Assert that two octrees are identical, including dtypes and bits."""
    assert (a.size, a.data_format, a.layout) == (b.size, b.data_format, b.layout)
    for name in ("node_children", "node_data", "origin", "voxel_size", "extra_data"):
        one, other = getattr(a, name), getattr(b, name)
        assert (one is None) == (other is None), name
        if one is not None:
            assert (one.dtype, one.shape) == (other.dtype, other.shape), name
            assert one.tobytes() == other.tobytes(), name


def voxel_centres(size: tuple[int, int, int]) -> npt.NDArray[np.float64]:
    """(W * H * D, 3) voxel centres in voxel coordinates, z fastest."""
    axes = (np.arange(edge) + 0.5 for edge in size)
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def world_centres(octree: SparseVoxelOctree) -> npt.NDArray[np.float64]:
    return octree.origin + voxel_centres(octree.size) * octree.voxel_size
