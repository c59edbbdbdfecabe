"""The page of an octree whose shader goes down from the root for each voxel: as TR-24-01 does it (docs/sources.md)."""

from __future__ import annotations

import pkgutil
import re
from dataclasses import replace

import numpy as np

from nerfbake.kernels.march.cells import EMPTY, rows_at
from nerfbake.scene.page_field import PageField, grid_of
from nerfbake.scene.radiance_field import RadianceField, leaves_of

_LOOK = re.compile(rb"^int look\(.*?^}\n", re.MULTILINE | re.DOTALL)


def octree_content(field: RadianceField, arranged: PageField) -> PageField:
    """The same colours, with the octree's nodes in place of the blocks of 4^3: two texels a node. field: an octree's,
    whose cells come in twos."""
    start, _ = grid_of(field.box)
    rows = np.full(len(field.values), -1, np.int64)
    for corners, _ in leaves_of(field.cells):
        middles = corners + 0.5
        rows[rows_at(field.cells, middles)] = arranged.rows(middles - start)
    slots, leaf = field.cells.slots, field.cells.slots < EMPTY
    numbers = rows[-2 - slots[leaf]]
    table = slots.copy()
    table[leaf] = np.where(numbers < 0, EMPTY, -2 - numbers)
    # Blocks come in eights; what is added is no node's.
    blocks = np.pad(table.reshape(-1, 4), ((0, -(len(table) // 4) % 8), (0, 0)), constant_values=EMPTY)
    return replace(arranged, blocks=blocks.view(np.uint32))


def with_octree_lookup(page: bytes, field: RadianceField) -> bytes:
    """A page of octree_content() with the lookup that reads it."""
    source = pkgutil.get_data("nerfbake", "shaders/bench/octree.glsl")
    assert source is not None
    x, y, z = grid_of(field.box)[0].tolist()
    head = f"const int HEIGHT = {len(field.cells.bits)};\nconst ivec3 START = ivec3({x}, {y}, {z});\n"
    changed, count = _LOOK.subn((head.encode() + source).replace(b"\\", b"\\\\"), page)
    assert count == 1, "the page's shader has no lookup of its own"
    return changed
