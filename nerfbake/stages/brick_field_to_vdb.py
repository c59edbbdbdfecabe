"""Field of bricks -> VDB grids, whose leaves are the field's bricks."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from nerfbake import memory
from nerfbake.kernels.arrays import Bits
from nerfbake.kernels.parallel import over_chunks
from nerfbake.kernels.vdb.bitmask import words_of
from nerfbake.kernels.vdb.bricks import Bricks
from nerfbake.scene.brick_field import BrickField
from nerfbake.scene.volume import OctreeFrame, Up, Volume
from nerfbake.stages._voxel_grids import WORK_BYTES, require_grids, volume_of_voxels
from nerfbake.stages.half import cast_values

_CHUNK = 512  # bricks at a time


def build_vdb_from_bricks(
    field: BrickField, *, grids: tuple[str, ...] = ("density", "Cd"), half: bool = False, up: Up = "z"
) -> Volume:
    """Convert a field of bricks to grids with one common topology. For grids, half and up see build_vdb().

    A voxel is a cell of the finest lattice. A wide cell becomes eight voxels with the same values; cells of density 0
    are background. build_octree_from_volume() of the grids returns the octree of build_octree_from_bricks(). Raises
    InvalidScene, and MemoryLimit before any grid is built.

    >>> import numpy as np
    >>> from nerfbake import BrickField, build_vdb_from_bricks
    >>> from nerfbake.scene.basis import Basis
    >>> rows = np.full((1, 512), -1, np.int32)
    >>> rows[0, [0, 1, 8, 9, 64, 65, 72, 73]] = 0 << 1 | 1
    >>> grey, box = np.array([[0, 0, 0, 50]], np.float32), np.array([[0.0] * 3, [1.0] * 3])
    >>> field = BrickField(8, box, Basis("SH", 1), np.zeros((1, 1, 1), np.int32), rows, grey)
    >>> print(build_vdb_from_bricks(field, grids=("index",)))
    VDB index grid (index), 8 voxels, float32
    """
    field.require_usable()
    field = field.shell(0)
    require_grids(grids, up, str(field.basis), field.basis.data_dim)
    sigma = np.ascontiguousarray(field.values[:, -1])
    values: npt.NDArray[Any] = field.values
    dtype = np.dtype(np.float16 if half else np.float32)
    if half and "index" in grids:  # rounding before wide cells become eight voxels takes a third of the memory
        values = cast_values(values, dtype, what="the field", asked="float16")
    bricks = _bricks(field, sigma > 0)
    memory.require("the field as voxels", len(bricks.node) * (values.itemsize * field.basis.data_dim + WORK_BYTES))
    edge = field.resolution
    frame = OctreeFrame((edge, edge, edge), str(field.basis), "full", field.box[0].copy(), field.cell_size)
    return memory.kept(volume_of_voxels(bricks, values, sigma, frame, grids=grids, dtype=dtype, up=up))


def _bricks(field: BrickField, filled: Bits) -> Bricks:
    """Return the bricks with the row of each voxel, for the cells that are filled (n,)."""
    mask = np.zeros((field.b, 8), np.uint64)
    nodes = [np.zeros(0, np.int32)] * (-(-field.b // _CHUNK) or 1)

    def work(begin: int, end: int) -> None:
        rows = field.rows[begin:end]
        held = rows >= 0
        held[held] = filled[rows[held] >> 1]
        mask[begin:end] = words_of(held)
        nodes[begin // _CHUNK] = rows[held] >> 1

    over_chunks(work, field.b, _CHUNK)
    return Bricks(field.brick_corners.astype(np.int64), mask, np.concatenate(nodes))
