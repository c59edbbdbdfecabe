"""Convert voxels in bricks of 8^3 to VDB grids: density, colour, SH coefficients, or one index grid."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake.errors import InvalidScene, Problem
from nerfbake.kernels.march.sh import sh_basis
from nerfbake.kernels.maths.affine import compose
from nerfbake.kernels.maths.elementary import sigmoid
from nerfbake.kernels.octree.node_values import ComputedRows
from nerfbake.kernels.parallel import over_chunks
from nerfbake.kernels.vdb.bitmask import in_order_of, popcount
from nerfbake.kernels.vdb.bricks import Bricks, NodeNumbers
from nerfbake.scene.basis import parse_basis
from nerfbake.scene.rows import RowsOfNodes
from nerfbake.scene.vdb import IndexGrid, VdbTree
from nerfbake.scene.vdb_topology import VdbTopology, topology_of_leaves
from nerfbake.scene.volume import OctreeFrame, Up, Volume
from nerfbake.stages.half import cast_values

GRIDS = ("density", "Cd", "sh", "index")
WORK_BYTES = 64  # per voxel, for its node and position while the tree is built
_CHUNK = 1 << 14  # voxels at a time


def require_grids(grids: tuple[str, ...], up: str, data_format: str, data_dim: int) -> None:
    """Raise InvalidScene for unknown grids, grids that are not available for this data_format, and an unknown axis."""
    known = set(grids) <= set(GRIDS) and len(set(grids)) == len(grids) > 0
    if not known or ("index" in grids and len(grids) > 1):
        raise InvalidScene(Problem("grids", f"are {','.join(grids)!r}", "some of density, Cd, sh, or index alone"))
    if up not in ("y", "z"):
        raise InvalidScene(Problem("up", f"is {up!r}", "y, z"))
    if "Cd" in grids and (not data_format or parse_basis(data_format).kind not in ("SH", "RGBA")):
        raise InvalidScene(Problem("grid 'Cd'", f"is not available for data_format {data_format!r}", "SH and RGBA"))
    if "sh" in grids and data_dim % 3 != 1:
        raise InvalidScene(Problem("grid 'sh'", f"is not available for {data_dim} values per node", "3 B + 1 values"))


def is_lazy(data: RowsOfNodes, dtype: np.dtype[Any]) -> bool:
    """Return True if the table of an index grid is computed only while it is written.

    This is so if the data are computed on demand as well, and need no rounding.
    """
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
    """Return the grids of these voxels. bricks.node is the row of each voxel in data (n, D) and in sigma (n,).

    If the data are computed on demand, the table of an index grid is, too (see is_lazy()).
    """
    topology, order = topology_of_leaves(bricks.low, bricks.mask)
    node = in_order_of(bricks.node, popcount(bricks.mask), order)
    rows = _Rows(data, sigma, frame.data_format, node)
    made = _grids(rows, grids, topology, dtype)
    return Volume(tuple(made), _transform(frame, up), frame)


class _Rows(NamedTuple):
    """The values of m voxels.

    data   (n, D), in this data_format
    sigma  (n,), if a density grid is requested
    node   (m,) the row of each voxel in data and sigma
    """

    data: RowsOfNodes
    sigma: npt.NDArray[Any] | None
    data_format: str
    node: NodeNumbers


class _TableRows(ComputedRows):
    """Rows (m + 1, D), computed on demand: one row of zeros, then the values of each voxel."""

    def __init__(self, data: RowsOfNodes, node: NodeNumbers) -> None:
        self._data, self._node = data, node
        self.shape, self.dtype = (len(node) + 1, data.shape[1]), data.dtype

    @property
    def held(self) -> int:
        """Bytes in memory before any row is computed, in addition to the octree's rows."""
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
        return VdbTree(name, topology, rounded(name, values, dtype), np.zeros(values.shape[1], np.float32))

    for grid in grids:
        if grid == "index":
            table = _TableRows(data, node)
            whole = table if is_lazy(data, dtype) else rounded(grid, np.asarray(table), dtype)
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
    """Return sRGB colours (m, 3): the sigmoid of each voxel's mean over all directions."""
    basis = parse_basis(rows.data_format)
    first = _picked(rows.data, rows.node, [0, basis.size, 2 * basis.size])
    scale = 1.0 if basis.kind == "RGBA" else float(sh_basis(np.array([[0.0, 0.0, 1.0]]), 1)[0, 0])
    colour = np.empty(first.shape, np.float32)

    def work(begin: int, end: int) -> None:
        colour[begin:end] = sigmoid(scale * first[begin:end].astype(np.float64))

    over_chunks(work, len(first), _CHUNK)
    return colour


def _picked(data: RowsOfNodes, node: NodeNumbers, columns: list[int]) -> npt.NDArray[Any]:
    """Return these columns of the data for each voxel, (m, len(columns))."""
    flat, width = np.asarray(data).reshape(-1), np.int64(data.shape[1])
    picked = np.empty((len(node), len(columns)), data.dtype)

    def work(begin: int, end: int) -> None:
        # Indexing the flat array takes two thirds of the time of data[node, columns].
        picked[begin:end] = flat[node[begin:end, None] * width + columns]

    over_chunks(work, len(node), _CHUNK)
    return picked


def rounded(name: str, values: npt.NDArray[Any], dtype: np.dtype[Any]) -> npt.NDArray[Any]:
    """Return the values of the grid `name` as dtype. Raises InvalidScene if one is too large for float16."""
    return cast_values(values, dtype, what=f"grid {name!r}", asked="`half`")


def _transform(frame: OctreeFrame, up: Up) -> npt.NDArray[np.float64]:
    """Return the transform (3, 4) from a voxel's index to its centre in the world."""
    transform = np.column_stack([np.diag(frame.voxel_size), frame.origin + frame.voxel_size / 2])
    if up == "z":
        return transform
    return compose(np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]), transform)
