"""Radiance field -> the arrays that the shader of a page reads."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake import memory
from nerfbake.errors import InvalidScene, Problem
from nerfbake.kernels.arrays import Ints
from nerfbake.kernels.dilation import dilated
from nerfbake.kernels.march.cells import rows_at
from nerfbake.scene.page import (
    ALL,
    BLOCK,
    FARTHEST,
    LARGEST,
    OCTANT,
    WHOLE,
    WIDE,
    PageField,
    density_unit,
    grid_of,
    part_at,
    texels_of,
)
from nerfbake.scene.radiance_field import RadianceField, leaves_of, require_field

_VOXEL_BYTES = 100  # per voxel during the conversion, in addition to its texels
_CELL_BYTES = 8  # per cell of the grid


def build_page_field(field: RadianceField) -> PageField:
    """Convert a field to the arrays of a shader.

    Values are rounded to float16. Leaves are split into voxels unless their width is a power of two, so that they are
    octants of 2^3, blocks of 4^3 or cells of 8^3. Raises InvalidScene if nothing is visible, MemoryLimit.

    >>> from nerfbake import build_field, build_page_field, sample_n3tree
    >>> print(build_page_field(build_field(sample_n3tree(resolution=16))))
    SH9 page field of 573 rows, 2x2x2 cells of 8^3
    """
    require_field(field)
    start, shape = grid_of(field.box)
    memory.require("the page's grid", _CELL_BYTES * shape[0] * shape[1] * shape[2])
    parts = _parts_of(field, start)
    rows = np.concatenate([parts.voxel_rows, parts.rows])
    if not len(rows):
        problem = Problem("the field", "has no leaf with a density", "at least one, or there is nothing to see")
        raise InvalidScene(problem)
    top, blocks = _structure(parts, shape)
    texels, unit = _texels(field, rows)
    place = field.place.copy()
    place[:, 3] -= start
    return memory.kept(PageField(top, blocks, texels, unit, place, field.box - start, field.basis))


def round_field(field: RadianceField) -> RadianceField:
    """Return the field with its values rounded to float16 as in build_page_field().

    >>> from nerfbake import build_field, round_field, sample_n3tree
    >>> field = build_field(sample_n3tree(resolution=8))
    >>> bool((round_field(field).values == field.values).all())
    True
    """
    require_field(field)
    values = np.clip(field.values, -LARGEST, LARGEST).astype(np.float16).astype(np.float32)
    unit = np.float32(density_unit(float(field.values[:, -1].max(initial=0))))
    values[:, -1] = (field.values[:, -1] / unit).astype(np.float16).astype(np.float32) * unit
    return memory.kept(replace(field, values=values))


class _Parts(NamedTuple):
    """Voxels (v, 3) in the order of their rows, with the field's row of each (v,), and leaves of 4^3 and more.

    A voxel that is `wide` (v,) is the lowest one of a leaf of 2^3. The larger leaves are given by their corners (w, 3),
    widths (w,) and the field's rows (w,).
    """

    voxels: Ints
    voxel_rows: Ints
    wide: npt.NDArray[np.bool_]
    corners: Ints
    widths: Ints
    rows: Ints


def _parts_of(field: RadianceField, start: Ints) -> _Parts:
    """Return leaves that are whole blocks or cells, in the order of their rows, and the voxels of all other leaves.

    Of a leaf of 2^3 only the lowest voxel is returned.
    """
    voxels, voxel_rows, wide = [np.zeros((0, 3), np.int64)], [np.zeros(0, np.int64)], [np.zeros(0, bool)]
    whole = [(np.zeros((0, 3), np.int64), np.zeros(0, np.int64), np.zeros(0, np.int64))]
    for corners, width in leaves_of(field.cells):
        rows = rows_at(field.cells, corners + 0.5)
        edge, low = int(width), corners.astype(np.int64) - start
        if edge % BLOCK == 0 and edge & edge - 1 == 0:
            whole.append((low, np.full(len(low), edge), rows))
            continue
        along = 1 if edge == OCTANT else edge
        memory.require("the voxels of the field", len(low) * along**3 * (_VOXEL_BYTES + 8 * texels_of(field.basis)))
        steps = np.stack(np.unravel_index(np.arange(along**3), (along,) * 3), axis=1)
        voxels.append((low[:, None] + steps).reshape(-1, 3))
        voxel_rows.append(np.repeat(rows, along**3))
        wide.append(np.full(len(voxel_rows[-1]), edge == OCTANT))
    all_voxels, leaves, octants = np.concatenate(voxels), np.concatenate(voxel_rows), np.concatenate(wide)
    corners, widths, rows = (np.concatenate(each) for each in zip(*whole, strict=True))
    # Voxels and leaves outside an octree's grid are never visible.
    end = np.ceil(field.box[1]).astype(np.int64) - start
    order = np.argsort(_key(all_voxels), kind="stable")
    order = order[(all_voxels[order] < end).all(axis=1)]
    by_row = np.argsort(rows, kind="stable")
    by_row = by_row[(corners[by_row] < end).all(axis=1)]
    return _Parts(all_voxels[order], leaves[order], octants[order], corners[by_row], widths[by_row], rows[by_row])


def _key(voxels: Ints) -> Ints:
    """Return sort keys: voxels are ordered by cell, then by block, then by bit."""
    x, y, z = voxels.T
    cell = (x >> 3) << 40 | (y >> 3) << 20 | z >> 3
    return np.asarray(cell << 9 | _block_and_bit(voxels), np.int64)


def _block_and_bit(voxels: Ints) -> Ints:
    x, y, z = voxels.T
    return np.asarray(part_at(x, y, z, BLOCK) << 6 | (x & 3) << 4 | (y & 3) << 2 | z & 3, np.int64)


def _structure(parts: _Parts, shape: tuple[int, int, int]) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.uint32]]:
    """Return the grid and the blocks. The rows of whole leaves follow those of the voxels."""
    top = np.full(shape, -1, np.int32)
    blocky = parts.widths == BLOCK
    numbers = len(parts.voxels) + np.arange(len(parts.rows))
    cells = np.concatenate([parts.voxels, parts.corners[blocky]]) >> 3
    occupied = np.zeros(shape, bool)
    occupied[tuple(cells.T)] = True
    top[occupied] = np.arange(np.count_nonzero(occupied), dtype=np.int32)
    for (x, y, z), width, number in zip(
        (parts.corners[~blocky] >> 3).tolist(),
        (parts.widths[~blocky] >> 3).tolist(),
        numbers[~blocky].tolist(),
        strict=True,
    ):
        top[x : x + width, y : y + width, z : z + width] = WHOLE + number
    blocks = np.zeros((8 * int(np.count_nonzero(occupied)), 4), np.uint32)
    inside = _block_and_bit(parts.voxels)
    block = 8 * top[tuple((parts.voxels >> 3).T)].astype(np.int64) + (inside >> 6)
    for half in (0, 1):
        mine = (inside >> 5 & 1) == half
        np.bitwise_or.at(blocks[:, half], block[mine], np.uint32(1) << (inside[mine] & 31).astype(np.uint32))
    blocks[:, 3] = np.bitwise_count(blocks[:, 0])
    counts = blocks[:, 3].astype(np.int64) + np.bitwise_count(blocks[:, 1])
    blocks[:, 2] = np.cumsum(counts) - counts
    x, y, z = parts.voxels[parts.wide].T
    flag = WIDE + part_at(x, y, z, OCTANT)
    np.bitwise_or.at(blocks[:, 3], block[parts.wide], np.uint32(1) << flag.astype(np.uint32))
    corner = parts.corners[blocky]
    own = 8 * top[tuple((corner >> 3).T)].astype(np.int64) + (_block_and_bit(corner) >> 6)
    blocks[own, :2], blocks[own, 2], blocks[own, 3] = 0xFFFFFFFF, numbers[blocky], ALL
    _set_distances(top)
    return top, blocks


def _set_distances(top: npt.NDArray[np.int32]) -> None:
    """Write minus the Chebyshev distance to the nearest occupied cell into each empty cell, at most FARTHEST."""
    reached = top >= 0
    for distance in range(1, FARTHEST + 1):
        top[~reached] = -distance
        reached = dilated(reached)
        if reached.all():
            break


def _texels(field: RadianceField, rows: Ints) -> tuple[npt.NDArray[np.float16], float]:
    B, T = field.basis.size, texels_of(field.basis)
    memory.require("the page's colours", len(rows) * (8 * T + 4 * field.values.shape[1]))
    unit = density_unit(float(field.values[:, -1].max()))
    flat = np.zeros((len(rows), 4 * T), np.float16)
    for channel in range(3):
        own = np.clip(field.values[:, channel * B : (channel + 1) * B], -LARGEST, LARGEST).astype(np.float16)
        flat[:, channel] = own[rows, 0]
        flat[:, 4 + channel : 4 + 3 * (B - 1) : 3] = own[rows, 1:]
    flat[:, 3] = (field.values[:, -1] / np.float32(unit)).astype(np.float16)[rows]
    return flat.reshape(len(rows), T, 4), unit
