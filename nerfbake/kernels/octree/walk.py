"""Walk the node table of an unvalidated tree, level by level, without recursion."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from nerfbake import memory
from nerfbake.errors import Problem
from nerfbake.kernels.arrays import Ints
from nerfbake.kernels.soundness import place, plural

# Bytes that a walk takes for each node, for each cell of a level, and for each of these cells with a pointer.
_PER_NODE, _PER_CELL, _PER_POINTER = 25, 5, 80


class Walk(NamedTuple):
    """The result of a walk: for each level the rows in breadth-first order, and the cell that points to each."""

    levels: list[Ints]
    cells: list[Ints]  # flat index row * C + cell of the parent's cell; -1 for the root
    problems: list[Problem]


def walk(
    n: int,
    targets: Callable[[Ints], tuple[Ints, Ints]],
    *,
    shape: tuple[int, ...],
    name: str,
    max_levels: int,
    later: bool,
) -> Walk:
    """Walk the nodes that the root reaches. Every invalid pointer is reported and not followed.

    targets(rows) returns which of the (m, C) cells of these rows point to a child, in order, and to which row each
    points. A node is entered once, the root never again, so the walk does not descend along cycles and shared children:
    time and memory are O(n C) for any table. With `later`, a child must come after its parent, as svox writes it.
    `shape` is the shape of the cells of one node, for messages. At most max_levels levels are walked.
    """
    cells_per_node = int(np.prod(shape))
    seen = np.zeros(n, bool)
    seen[0] = True
    first_claim = np.zeros(n, np.int64)
    levels, cells, problems = [np.zeros(1, np.int64)], [np.full(1, -1, np.int64)], _Problems(name, shape, n, later)
    while True:
        rows = levels[-1]
        memory.require(f"the walk over {name}", _PER_NODE * n + _PER_CELL * cells_per_node * len(rows))
        where, target = targets(rows)
        memory.require(f"the walk over {name}", _PER_NODE * n + _PER_POINTER * len(where))
        cell = rows[where // cells_per_node] * cells_per_node + where % cells_per_node
        wrong = (target < 1) | (target >= n)
        if later:
            wrong |= target <= cell // cells_per_node
        problems.add("points to node {}", cell[wrong], target[wrong])
        cell, target = cell[~wrong], target[~wrong]
        # If several cells point to a node, the first in order keeps it: it is written last.
        claims = np.arange(len(target))
        first_claim[target[::-1]] = claims[::-1]
        shared = seen[target] | (first_claim[target] != claims)
        problems.add("points to node {}, as another cell does", cell[shared], target[shared])
        cell, target = cell[~shared], target[~shared]
        if not len(target):
            return Walk(levels, cells, problems.found)
        if len(levels) == max_levels:
            problems.add_deep(cell, max_levels)
            return Walk(levels, cells, problems.found)
        seen[target] = True
        levels.append(target)
        cells.append(cell)


class _Problems:
    """Collects invalid pointers: one Problem for each kind and level."""

    def __init__(self, name: str, shape: tuple[int, ...], n: int, later: bool) -> None:
        self.name, self.shape, self.n, self.later = name, shape, n, later
        self.found: list[Problem] = []

    def add(self, text: str, cell: Ints, target: Ints) -> None:
        if not len(cell):
            return
        row = int(cell[0]) // int(np.prod(self.shape))
        low = row + 1 if self.later else 1
        nodes = (
            f"a node of {low} to {self.n - 1} that no other cell points to"
            if low < self.n
            else f"the tree has {plural(self.n, 'node')}"
        )
        self.found.append(Problem(self._place(cell), text.format(target[0]), f"0 (no child), {nodes}", len(cell)))

    def add_deep(self, cell: Ints, max_levels: int) -> None:
        self.found.append(
            Problem(self._place(cell), f"leads to level {max_levels}", f"levels 0 to {max_levels - 1}", len(cell))
        )

    def _place(self, cell: Ints) -> str:
        return place(self.name, np.unravel_index(int(cell[0]), (self.n, *self.shape)))
