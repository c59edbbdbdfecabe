"""Sparse voxel octree -> VDB grids: density, colour, SH coefficients, or all of it behind one index."""

from __future__ import annotations

from collections.abc import Iterator
from math import prod
from operator import mul
from typing import Any

import numpy as np
import numpy.typing as npt

from nerfbake import memory
from nerfbake.errors import InvalidScene, Problem
from nerfbake.kernels.march.sh import sh_basis
from nerfbake.kernels.maths.affine import combined
from nerfbake.kernels.maths.elementary import sigmoid
from nerfbake.kernels.parallel import over_chunks
from nerfbake.kernels.vdb.bitmask import popcount
from nerfbake.kernels.vdb.bricks import NodeNumbers, bricks_of
from nerfbake.kernels.vdb.runs import rows_of_runs
from nerfbake.scene.basis import parse_basis
from nerfbake.scene.octree import SparseVoxelOctree
from nerfbake.scene.vdb import IndexGrid, VdbTree
from nerfbake.scene.vdb_topology import VdbTopology
from nerfbake.scene.vdb_voxels import topology_of_leaves
from nerfbake.scene.volume import OctreeFrame, Up, Volume
from nerfbake.stages._half import rounded

GRIDS = ("density", "Cd", "sh", "index")
_CHUNK = 1 << 14  # voxels at a time
_WORK_BYTES = 64  # a voxel's node and place while the tree is built


def build_vdb(
    octree: SparseVoxelOctree,
    *,
    grids: tuple[str, ...] = ("density", "Cd"),
    half: bool = False,
    sigma_min: float | None = None,
    up: Up = "z",
) -> Volume:
    """The octree's voxels as grids over one topology.

    grids, any of these, `index` alone:
      density  float, 1/world unit
      Cd       colour, sRGB 0..1: the sigmoid of the SH's mean over all directions. Every basis function but the
               first averages to 0 over the sphere, so that mean is the first coefficient times 1 / (2 sqrt(pi)).
               (It is not the mean of the sigmoid, which no closed form gives; they agree where colour does not
               depend on the view.) RGBA has its colours as they are, behind the same sigmoid.
      sh       sh_0, sh_1, ...: the coefficients of red, green and blue of each basis function
      index    an IndexGrid with a table of all D values, density last

    Leaves above density 0 (and from sigma_min, 1/world unit) become voxels, large ones many; the rest is background,
    0. half: values are float16. up: the world's axis that the field's z becomes; `y` turns (x, y, z) into
    (x, z, -y) in the transform alone, voxels and SH stay as they are. Raises InvalidScene; MemoryLimit,
    before any voxel is made.

    >>> from nerfbake import build_octree, build_vdb, sample_n3tree
    >>> octree = build_octree(sample_n3tree(resolution=8))
    >>> [grid.name for grid in build_vdb(octree).grids]
    ['density', 'Cd']
    >>> [grid.name for grid in build_vdb(octree, grids=("index",)).grids]
    ['index']
    """
    _require_usable(octree, grids, up)
    if sigma_min is not None and not sigma_min >= 0:
        raise InvalidScene(Problem("sigma_min", f"is {sigma_min:g}", "0 or more"))
    sigma = np.ascontiguousarray(octree.sigma)  # a copy that lies together: a third of the time of each later read
    occupied = octree.childless & (sigma > 0) & (sigma >= (sigma_min or 0.0))
    _require_room(octree, occupied)
    bricks = bricks_of(octree.node_children, octree.level_sizes, occupied, octree.size)
    topology, order = topology_of_leaves(bricks.low, bricks.mask)
    node = bricks.node[rows_of_runs(popcount(bricks.mask), order)]
    frame = OctreeFrame(
        octree.size, octree.data_format, octree.layout, octree.origin, octree.voxel_size, octree.extra_data
    )
    dtype = np.dtype(np.float16 if half else np.float32)
    made = _grids(octree, grids, sigma, topology, node, dtype)
    return memory.kept(Volume(tuple(made), _transform(octree, up), frame))


def _grids(
    octree: SparseVoxelOctree,
    grids: tuple[str, ...],
    sigma: npt.NDArray[Any],
    topology: VdbTopology,
    node: NodeNumbers,
    dtype: np.dtype[Any],
) -> Iterator[VdbTree | IndexGrid]:
    data, B = octree.node_data, (octree.data_dim - 1) // 3

    def tree(name: str, values: npt.NDArray[Any]) -> VdbTree:
        return VdbTree(name, topology, _rounded(name, values, dtype), np.zeros(values.shape[1], np.float32))

    for grid in grids:
        if grid == "index":
            yield IndexGrid("index", topology, _rounded(grid, _table(data, node), dtype))
        elif grid == "density":
            yield tree("density", _picked(sigma[:, None], node, [0]))
        elif grid == "Cd":
            yield tree("Cd", _colour(octree, node))
        else:
            for k in range(B):
                yield tree(f"sh_{k}", _picked(data, node, [k, B + k, 2 * B + k]))


def _colour(octree: SparseVoxelOctree, node: NodeNumbers) -> npt.NDArray[np.float32]:
    """(m, 3) sRGB: what a voxel shows on average."""
    basis = parse_basis(octree.data_format)
    first = _picked(octree.node_data, node, [0, basis.size, 2 * basis.size])
    scale = 1.0 if basis.kind == "RGBA" else float(sh_basis(np.array([[0.0, 0.0, 1.0]]), 1)[0, 0])
    colour = np.empty(first.shape, np.float32)

    def work(begin: int, end: int) -> None:
        colour[begin:end] = sigmoid(scale * first[begin:end].astype(np.float64))

    over_chunks(work, len(first), _CHUNK)
    return colour


def _picked(data: npt.NDArray[Any], node: NodeNumbers, columns: list[int]) -> npt.NDArray[Any]:
    """(m, len(columns)) of each voxel's node these values."""
    flat, width = data.reshape(-1), np.int64(data.shape[1])
    picked = np.empty((len(node), len(columns)), data.dtype)

    def work(begin: int, end: int) -> None:
        # By their places in the flat array: two thirds of the time of data[node, columns].
        picked[begin:end] = flat[node[begin:end, None] * width + columns]

    over_chunks(work, len(node), _CHUNK)
    return picked


def _table(data: npt.NDArray[Any], node: NodeNumbers) -> npt.NDArray[Any]:
    """(m + 1, D) zeros, and each voxel's node."""
    table = np.zeros((len(node) + 1, data.shape[1]), data.dtype)

    def work(begin: int, end: int) -> None:
        np.take(data, node[begin:end], axis=0, out=table[1 + begin : 1 + end], mode="clip")  # raise would copy twice

    over_chunks(work, len(node), _CHUNK)
    return table


def _rounded(name: str, values: npt.NDArray[Any], dtype: np.dtype[Any]) -> npt.NDArray[Any]:
    return rounded(values, dtype, what=f"grid {name!r}", asked="--half")


def _transform(octree: SparseVoxelOctree, up: Up) -> npt.NDArray[np.float64]:
    """(3, 4) from a voxel's index to its centre in the world."""
    transform = np.column_stack([np.diag(octree.voxel_size), octree.origin + octree.voxel_size / 2])
    if up == "z":
        return transform
    return combined(np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]), transform)


# -- what may be asked -----------------------------------------------------------------------------------------
def _require_usable(octree: SparseVoxelOctree, grids: tuple[str, ...], up: str) -> None:
    octree.require_usable()
    known = set(grids) <= set(GRIDS) and len(set(grids)) == len(grids) > 0
    if not known or ("index" in grids and len(grids) > 1):
        raise InvalidScene(Problem("grids", f"are {','.join(grids)!r}", "some of density, Cd, sh, or index alone"))
    if up not in ("y", "z"):
        raise InvalidScene(Problem("up", f"is {up!r}", "y, z"))
    if "Cd" in grids and (not octree.data_format or parse_basis(octree.data_format).kind not in ("SH", "RGBA")):
        raise InvalidScene(Problem("grid 'Cd'", f"of data_format {octree.data_format!r}", "SH and RGBA"))
    if "sh" in grids and octree.data_dim % 3 != 1:
        raise InvalidScene(Problem("grid 'sh'", f"of {octree.data_dim} values a node", "3 B + 1 values"))


def _require_room(octree: SparseVoxelOctree, occupied: npt.NDArray[np.bool_]) -> None:
    """Raises MemoryLimit. Leaves that reach beyond the grid are counted whole, up to as many voxels as it has."""
    starts = np.cumsum([0, *octree.level_sizes[:-1]])
    leaves = np.add.reduceat(occupied, starts, dtype=np.int64)
    volumes = [8 ** (octree.grid_level - level) for level in range(len(starts))]  # Python's integers do not overflow
    voxels = min(sum(map(mul, leaves.tolist(), volumes)), prod(octree.size))
    need = voxels * (octree.data_dim * octree.node_data.itemsize + _WORK_BYTES)
    memory.require("the octree as voxels", need)
