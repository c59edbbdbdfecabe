"""Voxels in bricks of 8^3, and the rows that they hold -> VDB grids: density, colour, SH coefficients, or one index."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake.errors import InvalidScene, Problem
from nerfbake.kernels.march.sh import sh_basis
from nerfbake.kernels.maths.affine import combined
from nerfbake.kernels.maths.elementary import sigmoid
from nerfbake.kernels.octree.node_values import MadeRows
from nerfbake.kernels.parallel import over_chunks
from nerfbake.kernels.vdb.bitmask import popcount
from nerfbake.kernels.vdb.bricks import Bricks, NodeNumbers
from nerfbake.kernels.vdb.runs import in_order_of
from nerfbake.scene.basis import parse_basis
from nerfbake.scene.rows import RowsOfNodes
from nerfbake.scene.vdb import IndexGrid, VdbTree
from nerfbake.scene.vdb_topology import VdbTopology
from nerfbake.scene.vdb_voxels import topology_of_leaves
from nerfbake.scene.volume import OctreeFrame, Up, Volume
from nerfbake.stages._half import rounded

GRIDS = ("density", "Cd", "sh", "index")
WORK_BYTES = 64  # a voxel's node and place while the tree is built
_CHUNK = 1 << 14  # voxels at a time


def require_grids(grids: tuple[str, ...], up: str, data_format: str, data_dim: int) -> None:
    """Raises InvalidScene for grids that are none, or that this data_format has no values for, and for another axis."""
    known = set(grids) <= set(GRIDS) and len(set(grids)) == len(grids) > 0
    if not known or ("index" in grids and len(grids) > 1):
        raise InvalidScene(Problem("grids", f"are {','.join(grids)!r}", "some of density, Cd, sh, or index alone"))
    if up not in ("y", "z"):
        raise InvalidScene(Problem("up", f"is {up!r}", "y, z"))
    if "Cd" in grids and (not data_format or parse_basis(data_format).kind not in ("SH", "RGBA")):
        raise InvalidScene(Problem("grid 'Cd'", f"of data_format {data_format!r}", "SH and RGBA"))
    if "sh" in grids and data_dim % 3 != 1:
        raise InvalidScene(Problem("grid 'sh'", f"of {data_dim} values a node", "3 B + 1 values"))


def made_later(data: RowsOfNodes, dtype: np.dtype[Any]) -> bool:
    """Whether the table of an index is left to be made as it is written: where data are, and nothing is rounded."""
    return not isinstance(data, np.ndarray) and data.dtype == dtype


def volume_of_voxels(
    bricks: Bricks,
    data: RowsOfNodes,
    sigma: npt.NDArray[Any] | None,
    frame: OctreeFrame,
    *,
    grids: tuple[str, ...],
    dtype: np.dtype[Any],
    up: Up,
) -> Volume:
    """The grids of these voxels; bricks.node says which row of data (n, D), and of sigma (n,), each of them holds.

    The table of an index whose data are still to be made is still to be made, too.
    """
    topology, order = topology_of_leaves(bricks.low, bricks.mask)
    node = in_order_of(bricks.node, popcount(bricks.mask), order)
    rows = _Rows(data, sigma, frame.data_format, node)
    made = _grids(rows, grids, topology, dtype)
    return Volume(tuple(made), _transform(frame, up), frame)


class _Rows(NamedTuple):
    """data (n, D), in this data_format, sigma (n,) where density is asked for, (m,) the row that each voxel holds."""

    data: RowsOfNodes
    sigma: npt.NDArray[Any] | None
    data_format: str
    node: NodeNumbers


class _TableRows(MadeRows):
    """(m + 1, D) zeros, and each voxel's node: rows that are made when they are asked for."""

    def __init__(self, data: RowsOfNodes, node: NodeNumbers) -> None:
        self._data, self._node = data, node
        self.shape, self.dtype = (len(node) + 1, data.shape[1]), data.dtype

    @property
    def held(self) -> int:
        """What is in memory before any of them is asked for, beside the octree's own rows."""
        return self._node.nbytes

    def __getitem__(self, rows: slice) -> npt.NDArray[Any]:
        begin, end, _ = rows.indices(self.shape[0])
        own = self._data.take(self._node[max(begin - 1, 0) : max(end - 1, 0)], axis=0)
        return own if begin else np.concatenate([np.zeros((min(end, 1), self.shape[1]), self.dtype), own])


def _grids(
    rows: _Rows, grids: tuple[str, ...], topology: VdbTopology, dtype: np.dtype[Any]
) -> Iterator[VdbTree | IndexGrid]:
    data, node, B = rows.data, rows.node, (rows.data.shape[1] - 1) // 3

    def tree(name: str, values: npt.NDArray[Any]) -> VdbTree:
        return VdbTree(name, topology, _rounded(name, values, dtype), np.zeros(values.shape[1], np.float32))

    for grid in grids:
        if grid == "index":
            table = _TableRows(data, node)
            whole = table if made_later(data, dtype) else _rounded(grid, np.asarray(table), dtype)
            yield IndexGrid("index", topology, whole)
        elif grid == "density":
            assert rows.sigma is not None
            yield tree("density", _picked(rows.sigma[:, None], node, [0]))
        elif grid == "Cd":
            yield tree("Cd", _colour(rows))
        else:
            for k in range(B):
                yield tree(f"sh_{k}", _picked(data, node, [k, B + k, 2 * B + k]))


def _colour(rows: _Rows) -> npt.NDArray[np.float32]:
    """(m, 3) sRGB: what a voxel shows on average."""
    basis = parse_basis(rows.data_format)
    first = _picked(rows.data, rows.node, [0, basis.size, 2 * basis.size])
    scale = 1.0 if basis.kind == "RGBA" else float(sh_basis(np.array([[0.0, 0.0, 1.0]]), 1)[0, 0])
    colour = np.empty(first.shape, np.float32)

    def work(begin: int, end: int) -> None:
        colour[begin:end] = sigmoid(scale * first[begin:end].astype(np.float64))

    over_chunks(work, len(first), _CHUNK)
    return colour


def _picked(data: RowsOfNodes, node: NodeNumbers, columns: list[int]) -> npt.NDArray[Any]:
    """(m, len(columns)) of each voxel's node these values."""
    flat, width = np.asarray(data).reshape(-1), np.int64(data.shape[1])
    picked = np.empty((len(node), len(columns)), data.dtype)

    def work(begin: int, end: int) -> None:
        # By their places in the flat array: two thirds of the time of data[node, columns].
        picked[begin:end] = flat[node[begin:end, None] * width + columns]

    over_chunks(work, len(node), _CHUNK)
    return picked


def _rounded(name: str, values: npt.NDArray[Any], dtype: np.dtype[Any]) -> npt.NDArray[Any]:
    return rounded(values, dtype, what=f"grid {name!r}", asked="`half`")


def _transform(frame: OctreeFrame, up: Up) -> npt.NDArray[np.float64]:
    """(3, 4) from a voxel's index to its centre in the world."""
    transform = np.column_stack([np.diag(frame.voxel_size), frame.origin + frame.voxel_size / 2])
    if up == "z":
        return transform
    return combined(np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]), transform)
