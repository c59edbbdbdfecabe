"""The nodes of the PlenOctree (N = 2) whose leaves are the cells of a field of bricks, without their values.

Leaves contain the rows of their cells: these take 4 bytes, and values a hundred or two. Whoever needs a tree of the
values copies them once, and whoever renders the field does not copy them at all.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake import memory
from nerfbake.kernels.arrays import Bits, Ints
from nerfbake.kernels.octree.brick_nodes import brick_nodes, numbered
from nerfbake.kernels.octree.lookup import dilate
from nerfbake.kernels.parallel import over_chunks
from nerfbake.kernels.vdb.bitmask import exclusive_sum
from nerfbake.scene.brick_field import EMPTY, BrickField

_CHUNK = 256  # bricks at a time: their cells stay in the second-level cache
_NODE_BYTES = 8 * 8  # of the tables of a node


class BrickTree(NamedTuple):
    """child (n, 8) int32: as in N3Tree. row (n, 8) int32: the row of a leaf's cell; -1: an empty leaf, or no leaf."""

    child: npt.NDArray[np.int32]
    row: npt.NDArray[np.int32]

    @property
    def n(self) -> int:
        """Number of nodes."""
        return len(self.child)

    @property
    def nbytes(self) -> int:
        return self.child.nbytes + self.row.nbytes


def tree_of_bricks(field: BrickField, filled: Bits) -> BrickTree:
    """Return the tree of the field's box or, with scenery, of its outermost shell. Raises MemoryLimit.

    filled (n,): the rows whose cells are leaves; all others are empty.
    """
    shells = [_shell_tree(field, number, filled) for number in reversed(range(field.shells))]
    return _nested(shells) if len(shells) > 1 else shells[0]


def _shell_tree(field: BrickField, shell: int, filled: Bits) -> BrickTree:
    r = field.top.shape[1]
    held = field.top[shell * r : (shell + 1) * r] >= 0
    before = int(np.count_nonzero(field.top[: shell * r] >= 0))
    places = np.argwhere(held)
    rows = field.rows[before : before + len(places)]
    bricks, codes = _bricks(places, rows, filled)
    above = _above(codes, r.bit_length() - 1)
    first = sum(len(level) for level, _ in above)  # the bricks' nodes follow all nodes above them
    n = max(first + int(bricks.nodes.sum()), 1)
    memory.require("the tree", n * _NODE_BYTES)
    tree = BrickTree(np.zeros((n, 8), np.int32), np.full((n, 8), EMPTY, np.int32))
    _link_above(tree.child, above)
    _fill(rows, filled, bricks, first, tree)
    return tree


def _nested(trees: list[BrickTree]) -> BrickTree:
    """Return the trees as one, each in the middle half of the one before; the middle of each but the last is empty.

    The octant o of a tree's root takes the place of cell 7 - o in the octant o of the next larger tree.
    """
    roots = [tree.child[0].copy() for tree in trees]
    # An empty inner cube has nodes, too: a reader counts its shells by the levels of nodes.
    for root, tree in zip(roots if trees[-1].n == 1 else roots[:-1], trees, strict=False):
        missing = np.flatnonzero(root == 0)
        root[missing] = tree.n + np.arange(len(missing))  # empty nodes that follow those of the tree
    counts = [max(tree.n, int(root.max()) + 1) for tree, root in zip(trees, roots, strict=True)]
    n = sum(counts) - len(trees) + 1  # no tree but the largest has a row for its root
    memory.require("the tree of all shells", n * _NODE_BYTES)
    child, row = np.zeros((n, 8), np.int32), np.full((n, 8), EMPTY, np.int32)
    octant_rows, start = np.zeros(8, np.int64), 0  # octant_rows: of the larger tree
    for number, (tree, root, count) in enumerate(zip(trees, roots, counts, strict=True)):
        skipped = min(number, 1)
        end = start + tree.n - skipped
        child[start:end], row[start:end] = tree.child[skipped:], tree.row[skipped:]
        octants = np.where(root > 0, start + root - skipped, 0)
        if number == 0:
            child[0] = root
        for o in np.flatnonzero(octants) if number else ():
            child[octant_rows[o], 7 - o] = octants[o] - octant_rows[o]
        octant_rows, start = octants, start + count - skipped
    return BrickTree(child, row)


class _Bricks(NamedTuple):
    """The bricks that are not empty.

    order  (q,) their indices, in the order of the tree
    nodes  (q, 3) number of nodes of 8^3, 4^3 and 2^3 cells in each
    """

    order: Ints
    nodes: Ints


def _bricks(places: Ints, rows: npt.NDArray[np.int32], filled: Bits) -> tuple[_Bricks, Ints]:
    """Return the bricks, and their paths from the root (q,) as octants 4x + 2y + z, in ascending order.

    places (b, 3): of the bricks in their grid; rows (b, 512): as in BrickField.
    """
    x, y, z = (dilate(places[:, axis]) for axis in range(3))
    codes = x << 2 | y << 1 | z
    order = np.argsort(codes)
    nodes = np.empty((len(order), 3), np.int64)

    def count(begin: int, end: int) -> None:
        found = brick_nodes(rows[order[begin:end]], filled)
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


def _fill(rows: npt.NDArray[np.int32], filled: Bits, bricks: _Bricks, first: int, tree: BrickTree) -> None:
    """Link the nodes in the bricks, level by level, and give each leaf the row of its cell."""
    of_level = bricks.nodes.sum(axis=0)
    starts = first + exclusive_sum(of_level) + (np.cumsum(bricks.nodes, axis=0) - bricks.nodes)
    child, leaves, octants = tree.child, tree.row.reshape(-1), np.arange(8)

    def work(begin: int, end: int) -> None:
        found = brick_nodes(rows[bricks.order[begin:end]], filled)
        own, blocks, smallest = (starts[begin:end, level] for level in range(3))
        block = numbered(found.blocks, blocks)
        small = numbered(found.split, smallest)
        child[own] = np.where(found.blocks, block - own[:, None], 0)
        child[block[found.blocks]] = np.where(found.split, small - block[..., None], 0)[found.blocks]
        cells = block[..., None] * 8 + octants
        leaves[cells[found.wide]] = found.row[..., 0][found.wide]
        alone = found.held & found.split[..., None]
        leaves[(small[..., None] * 8 + octants)[alone]] = found.row[alone]

    over_chunks(work, len(bricks.order), _CHUNK)
