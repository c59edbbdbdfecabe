"""PlenOctree -> the field that a marcher reads."""

from __future__ import annotations

import numpy as np

from nerfbake import memory
from nerfbake.kernels.march.cells import EMPTY, cells_of
from nerfbake.scene.basis import shown_basis
from nerfbake.scene.n3tree import N3Tree
from nerfbake.scene.radiance_field import RadianceField, leaf_box


def field_of_n3tree(tree: N3Tree) -> RadianceField:
    """Its nodes as they are, its leaves with a density above 0. Raises InvalidScene for what cannot be shown.

    >>> from nerfbake import field_of_n3tree, sample_n3tree
    >>> print(field_of_n3tree(sample_n3tree(resolution=8)))
    SH9 field of 167 leaves over 8^3 cells
    """
    tree.require_usable()
    basis = shown_basis(tree.data_format)
    data = tree.data.reshape(-1, tree.data_dim)
    held = np.flatnonzero(tree.leaf_mask.reshape(-1) & (data[:, -1] > 0))
    slots = np.full(tree.child.size, EMPTY, np.int32)
    slots[held] = -2 - np.arange(len(held), dtype=np.int32)
    for rows, children in zip(tree.levels[1:], tree.parent_cells[1:], strict=True):
        slots[children] = rows
    N, bits = tree.N, (tree.N - 1).bit_length()
    wide = 1 << bits
    if wide > N:
        own, slots = slots.reshape(tree.n, N, N, N), np.full(tree.n * wide**3, EMPTY, np.int32)
        slots.reshape(tree.n, wide, wide, wide)[:, :N, :N, :N] = own
    cells = cells_of(slots, [bits] * len(tree.levels), radix=N if wide > N else 0)
    place = cells.edge * np.column_stack([np.diag(tree.invradius), tree.offset])
    return memory.kept(RadianceField(cells, data[held].astype(np.float32), place, leaf_box(cells), basis))
