"""Field of bricks -> PlenOctree, whose leaves are the field's cells."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake import memory
from nerfbake.kernels.arrays import Bits, Indices, Ints
from nerfbake.kernels.octree.brick_nodes import brick_nodes, numbered
from nerfbake.kernels.octree.lookup import dilate
from nerfbake.kernels.parallel import over_chunks
from nerfbake.kernels.vdb.bitmask import exclusive_sum
from nerfbake.scene.brick_field import BrickField
from nerfbake.scene.n3tree import N3Tree
from nerfbake.stages.half import cast_values

_CHUNK = 256  # bricks at a time: their cells stay in the second-level cache


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
    shells = [_shell_tree(field.shell(number), dtype) for number in reversed(range(field.shells))]
    return memory.kept(_nested(shells) if len(shells) > 1 else shells[0])


def _shell_tree(field: BrickField, dtype: Literal["float32", "float16"]) -> N3Tree:
    """Return the tree of a field without shells."""
    values = cast_values(field.values, np.dtype(dtype), what="the field", asked="float16")
    filled = values[:, -1] > 0
    bricks, codes = _bricks(field, filled)
    above = _above(codes, (field.resolution // 8).bit_length() - 1)
    first = sum(len(level) for level, _ in above)  # the bricks' nodes follow all nodes above them
    n = max(first + int(bricks.nodes.sum()), 1)
    width = field.basis.data_dim
    memory.require("the tree", n * 8 * (width * values.itemsize + 4))
    child, data = np.zeros((n, 8), np.int32), np.zeros((n * 8, width), values.dtype)
    _link_above(child, above)
    _fill(field, values, filled, bricks, first, child, data)
    edges = field.box[1] - field.box[0]
    return N3Tree(
        child=child.reshape(n, 2, 2, 2),
        data=data.reshape(n, 2, 2, 2, width),
        offset=-field.box[0] / edges,
        invradius=1 / edges,
        data_format=str(field.basis),
    )


def _nested(trees: list[N3Tree]) -> N3Tree:
    """Return the trees as one, each in the middle half of the one before; the middle of each but the last is empty.

    The octant o of a tree's root takes the place of cell 7 - o in the octant o of the next larger tree. The list is
    emptied on the way, so that the trees do not need their memory twice.
    """
    largest, roots = trees[0], [tree.child[0].reshape(8).copy() for tree in trees]
    # An empty inner cube has nodes, too: a reader counts its shells by the levels of nodes.
    for root, tree in zip(roots if trees[-1].n == 1 else roots[:-1], trees, strict=False):
        missing = np.flatnonzero(root == 0)
        root[missing] = tree.n + np.arange(len(missing))  # empty nodes that follow those of the tree
    counts = [max(tree.n, int(root.max()) + 1) for tree, root in zip(trees, roots, strict=True)]
    n, width = sum(counts) - len(trees) + 1, largest.data.shape[-1]  # no tree but the largest has a row for its root
    memory.require("the tree of all shells", n * 8 * (width * largest.data.itemsize + 4))
    child, data = np.zeros((n, 8), np.int32), np.zeros((n, 8, width), largest.data.dtype)
    shells, rows, start = len(trees), np.zeros(8, np.int64), 0  # rows: of the octants of the larger tree
    for number, (root, count) in enumerate(zip(roots, counts, strict=True)):
        tree, skipped = trees.pop(0), min(number, 1)
        end = start + tree.n - skipped
        child[start:end] = tree.child.reshape(-1, 8)[skipped:]
        data[start:end] = tree.data.reshape(-1, 8, width)[skipped:]
        octants = np.where(root > 0, start + root - skipped, 0)
        if number == 0:
            child[0] = root
        for o in np.flatnonzero(octants) if number else ():
            child[rows[o], 7 - o] = octants[o] - rows[o]
        rows, start = octants, start + count - skipped
    return replace(largest, shells=shells, child=child.reshape(n, 2, 2, 2), data=data.reshape(n, 2, 2, 2, width))


class _Bricks(NamedTuple):
    """The bricks that are not empty.

    order  (q,) their indices, in the order of the tree
    nodes  (q, 3) number of nodes of 8^3, 4^3 and 2^3 cells in each
    """

    order: Ints
    nodes: Ints


def _bricks(field: BrickField, filled: Bits) -> tuple[_Bricks, Ints]:
    """Return the bricks, and their paths from the root (q,) as octants 4x + 2y + z, in ascending order."""
    x, y, z = (dilate(field.brick_corners[:, axis].astype(np.int64) >> 3) for axis in range(3))
    codes = x << 2 | y << 1 | z
    order = np.argsort(codes)
    nodes = np.empty((len(order), 3), np.int64)

    def count(begin: int, end: int) -> None:
        found = brick_nodes(field.rows[order[begin:end]], filled)
        nodes[begin:end, 1] = np.count_nonzero(found.blocks, axis=1)
        nodes[begin:end, 2] = np.count_nonzero(found.split, axis=(1, 2))

    over_chunks(count, len(order), _CHUNK)
    nodes[:, 0] = nodes[:, 1] > 0
    kept = nodes[:, 0] > 0
    return _Bricks(order[kept], nodes[kept]), codes[order][kept]


def _above(codes: Ints, height: int) -> list[tuple[Ints, Ints]]:
    """Return for each level above the bricks the paths of its nodes (m,), and the paths of the nodes one level below.

    A tree of one brick has no such level; a tree without bricks consists of its root.
    """
    levels: list[tuple[Ints, Ints]] = []
    for _ in range(height):
        parents = codes >> 3
        own = parents[np.diff(parents, prepend=-1) != 0]
        levels.insert(0, (own, codes))
        codes = own
    return levels


def _link_above(child: npt.NDArray[np.int32], above: list[tuple[Ints, Ints]]) -> None:
    start = 0
    for own, below in above:
        row, next_row = start + np.searchsorted(own, below >> 3), start + len(own) + np.arange(len(below))
        child[row, below & 7] = next_row - row
        start += len(own)


def _fill(
    field: BrickField,
    values: npt.NDArray[np.float32] | npt.NDArray[np.float16],
    filled: Bits,
    bricks: _Bricks,
    first: int,
    child: npt.NDArray[np.int32],
    data: npt.NDArray[np.float32] | npt.NDArray[np.float16],
) -> None:
    """Link the nodes in the bricks, level by level, and copy each cell to its leaf."""
    of_level = bricks.nodes.sum(axis=0)
    starts = first + exclusive_sum(of_level) + (np.cumsum(bricks.nodes, axis=0) - bricks.nodes)
    octants = np.arange(8)

    def copy(cells: Indices, rows: Indices) -> None:
        data[cells] = values[rows]

    def work(begin: int, end: int) -> None:
        found = brick_nodes(field.rows[bricks.order[begin:end]], filled)
        own, blocks, smallest = (starts[begin:end, level] for level in range(3))
        block = numbered(found.blocks, blocks)
        small = numbered(found.split, smallest)
        child[own] = np.where(found.blocks, block - own[:, None], 0)
        child[block[found.blocks]] = np.where(found.split, small - block[..., None], 0)[found.blocks]
        cells = block[..., None] * 8 + octants
        copy(cells[found.wide], found.row[..., 0][found.wide])
        alone = found.held & found.split[..., None]
        copy((small[..., None] * 8 + octants)[alone], found.row[alone])

    over_chunks(work, len(bricks.order), _CHUNK)
