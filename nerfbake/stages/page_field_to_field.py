"""What a page's shader reads -> the field that a marcher reads: the page's twin, for whoever judges a page."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from nerfbake import memory
from nerfbake.kernels.march.cells import EMPTY, Cells, cells_of
from nerfbake.scene.page_field import ALL, CELL, WHOLE, PageField
from nerfbake.scene.radiance_field import RadianceField, require_field
from nerfbake.stages._tile_levels import tile_levels

STEPS = 255  # that eight bits tell apart


def field_of_page_field(page_field: PageField) -> RadianceField:
    """The same field for render_field(): every value as the page has it, in the same place.

    Raises MemoryLimit.

    >>> from nerfbake import build_field, build_page_field, field_of_page_field, sample_n3tree
    >>> page_field = build_page_field(build_field(sample_n3tree(resolution=16)))
    >>> print(field_of_page_field(page_field))
    SH9 field of 1,252 leaves over 16^3 cells
    """
    rows = len(page_field.texels)
    memory.require("the page's field", rows * 4 * page_field.basis.data_dim + len(page_field.blocks) * 64 * (4 + 16))
    return memory.kept(
        RadianceField(_cells(page_field), page_field.values, page_field.place, page_field.box, page_field.basis)
    )


def round_to_bytes(field: RadianceField) -> RadianceField:
    """The same field with its coefficients as a page keeps compressed data, in eight bits each; densities stay.

    The k-th coefficients of red, green and blue are low + width q / 255: `low` is the least of each colour, `width` the
    largest distance from there in any of the three, q a whole number.

    >>> from nerfbake import build_field, round_to_bytes, sample_n3tree
    >>> field = build_field(sample_n3tree(resolution=8))
    >>> rounded = round_to_bytes(field)
    >>> bool((rounded.values[:, -1] == field.values[:, -1]).all())
    True
    """
    require_field(field)
    B = field.basis.size
    values = field.values.copy()
    for k in range(B):
        own = field.values[:, k : 3 * B : B].astype(np.float64)
        low = own.min(axis=0, initial=np.inf) if len(own) else np.zeros(3)
        width = float((own - low).max(initial=0)) or 1.0
        steps = np.floor((own - low) / width * STEPS + 0.5)
        values[:, k : 3 * B : B] = low + width * (steps / STEPS)
    return memory.kept(replace(field, values=values))


def _cells(page_field: PageField) -> Cells:
    """An octree down to the top cells, and below it a table of 8^3 for each leaf."""
    top = page_field.top
    held = np.argwhere(top >= 0)
    number = top[tuple(held.T)].astype(np.int64)
    number = np.where(number >= WHOLE, -2 - (number - WHOLE), number)
    levels = tile_levels(held, number, height=(max(top.shape) - 1).bit_length())
    tables = _tables(page_field)
    if not levels and len(number) and number[0] < EMPTY:
        tables[:] = number[0]  # the only cell is one row
    bits = [1] * len(levels) + [CELL.bit_length() - 1]
    levels.append(tables)
    first = np.cumsum([0, *(level.size for level in levels[:-1])]).tolist()
    return cells_of(np.concatenate([level.reshape(-1) for level in levels]), bits, first=first)


def _tables(page_field: PageField) -> npt.NDArray[np.int32]:
    """(leaves, 512) the slots of each leaf, x-major."""
    blocks = page_field.blocks
    masks = np.ascontiguousarray(blocks[:, :2]).astype("<u4").view(np.uint8)
    bits = np.unpackbits(masks, axis=1, bitorder="little")  # (8 leaves, 64)
    whole = blocks[:, 3] == ALL
    before = np.where(whole[:, None], 0, np.cumsum(bits, axis=1) - bits)
    slots = np.where(bits, -2 - (blocks[:, 2].astype(np.int64)[:, None] + before), EMPTY).astype(np.int32)
    # Axes: leaf; the block's x, y, z; the voxel's x, y, z in it.
    tables = slots.reshape(-1, 2, 2, 2, 4, 4, 4).transpose(0, 1, 4, 2, 5, 3, 6).reshape(-1, CELL**3)
    return np.ascontiguousarray(tables) if len(tables) else np.full((1, CELL**3), EMPTY, np.int32)
