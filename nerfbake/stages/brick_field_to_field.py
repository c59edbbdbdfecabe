"""Field of bricks -> the field that a marcher reads: a grid of bricks, below it cells two and one voxels wide."""

from __future__ import annotations

import numpy as np

from nerfbake import memory
from nerfbake.kernels.march.cells import EMPTY, Cells, cells_of
from nerfbake.kernels.octree.brick_nodes import BLOCK_PATHS, brick_nodes, numbered
from nerfbake.kernels.parallel import over_chunks
from nerfbake.kernels.vdb.bitmask import exclusive_sum
from nerfbake.scene.brick_field import BrickField
from nerfbake.scene.radiance_field import RadianceField, leaf_box

_CHUNK = 256  # bricks at a time: their cells stay in the second-level cache


def field_of_bricks(bricks: BrickField) -> RadianceField:
    """Its cells with a density above 0, wide ones as one cell each. Raises InvalidScene for a broken field.

    >>> import numpy as np
    >>> from nerfbake import BrickField, field_of_bricks
    >>> from nerfbake.scene.basis import Basis
    >>> rows = np.full((1, 512), -1, np.int32)
    >>> rows[0, 0] = 0
    >>> grey, box = np.array([[0, 0, 0, 50]], np.float32), np.array([[0.0] * 3, [1.0] * 3])
    >>> print(field_of_bricks(BrickField(8, box, Basis("SH", 1), np.zeros((1, 1, 1), np.int32), rows, grey)))
    SH1 field of 1 leaves over 8^3 cells
    """
    bricks.require_usable()
    cells = _cells(bricks)
    scale = bricks.resolution / (bricks.box[1] - bricks.box[0])
    place = np.column_stack([np.diag(scale), -bricks.box[0] * scale])
    return memory.kept(RadianceField(cells, bricks.values, place, leaf_box(cells), bricks.basis))


def _cells(bricks: BrickField) -> Cells:
    filled = bricks.values[:, -1] > 0
    split = np.empty(bricks.b, np.int64)

    def count(begin: int, end: int) -> None:
        split[begin:end] = np.count_nonzero(brick_nodes(bricks.rows[begin:end], filled).split, axis=(1, 2))

    over_chunks(count, bricks.b, _CHUNK)
    top = bricks.top.size
    memory.require("the field's cells", 4 * (top + 64 * bricks.b + 8 * int(split.sum())))
    blocks = np.empty((bricks.b, 64), np.int32)
    smallest = np.empty((int(split.sum()), 8), np.int32)
    number = exclusive_sum(split)

    def fill(begin: int, end: int) -> None:
        found = brick_nodes(bricks.rows[begin:end], filled)
        below = numbered(found.split, number[begin:end])
        leaf = np.where(found.wide, -2 - found.row[..., 0], EMPTY)
        blocks[begin:end, BLOCK_PATHS] = np.where(found.split, below, leaf).reshape(-1, 64)
        cells = np.where(found.held, -2 - found.row, EMPTY)
        smallest[below[found.split]] = cells[found.split]

    over_chunks(fill, bricks.b, _CHUNK)
    levels = [np.maximum(bricks.top, EMPTY).reshape(-1), blocks.reshape(-1), smallest.reshape(-1)]
    first = [0, top, top + blocks.size]
    return cells_of(np.concatenate(levels), [(bricks.resolution // 8).bit_length() - 1, 2, 1], first=first)
