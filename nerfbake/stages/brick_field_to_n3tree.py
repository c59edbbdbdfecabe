"""Field of bricks -> PlenOctree, whose leaves are the field's cells."""

from __future__ import annotations

from typing import Literal

import numpy as np

from nerfbake import memory
from nerfbake.kernels.parallel import over_chunks
from nerfbake.scene.brick_field import BrickField
from nerfbake.scene.n3tree import N3Tree
from nerfbake.stages._brick_tree import tree_of_bricks
from nerfbake.stages.half import require_range

_NODES = 1 << 10  # at a time: the values of their leaves stay in the second-level cache


def build_n3tree(field: BrickField, *, dtype: Literal["float32", "float16"] = "float32") -> N3Tree:
    """Convert a field of bricks to a PlenOctree (N = 2). Each cell becomes a leaf of its size and keeps its values.

    Cells of density 0 are empty leaves. The tree's cube is the field's box, whose edges may differ in length, or its
    outermost shell: the inner cube of a field with scenery is then the cube of 1 / 2^k of its edge in the middle.
    float16 rounds the values. Raises InvalidScene for a broken field and for values that are too large for float16;
    MemoryLimit.

    >>> import numpy as np
    >>> from nerfbake import BrickField, build_n3tree
    >>> from nerfbake.scene.basis import Basis
    >>> rows = np.full((1, 512), -1, np.int32)
    >>> rows[0, 0] = 0
    >>> grey, box = np.array([[0, 0, 0, 50]], np.float32), np.array([[0.0] * 3, [1.0] * 3])
    >>> tree = build_n3tree(BrickField(8, box, Basis("SH", 1), np.zeros((1, 1, 1), np.int32), rows, grey))
    >>> print(tree)
    SH1 PlenOctree of 8^3, 3 nodes
    >>> tree.sample([[0.1, 0.1, 0.1], [0.2, 0.1, 0.1]])[:, 3]
    array([50.,  0.], dtype=float32)
    """
    field.require_usable()
    values, made = field.values, np.dtype(dtype)
    require_range(values, made, what="the field", asked="float16")
    tree = tree_of_bricks(field, values[:, -1].astype(made) > 0)  # float16 rounds small densities to 0
    memory.require("the tree", tree.nbytes + tree.n * 8 * field.basis.data_dim * made.itemsize)
    data = np.zeros((tree.n, 8, field.basis.data_dim), made)

    def fill(begin: int, end: int) -> None:
        rows = tree.row[begin:end]
        held = rows >= 0
        data[begin:end][held] = values[rows[held]]

    over_chunks(fill, tree.n, _NODES)
    low, high = field.shell_box(field.shells - 1)
    return memory.kept(
        N3Tree(
            child=tree.child.reshape(-1, 2, 2, 2),
            data=data.reshape(-1, 2, 2, 2, field.basis.data_dim),
            offset=-low / (high - low),
            invradius=1 / (high - low),
            data_format=str(field.basis),
            shells=field.shells,
        )
    )
