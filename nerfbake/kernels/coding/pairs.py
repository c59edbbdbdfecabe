"""References of each pair of the Haar transform: pairs that are coded before it and likely have similar coefficients.

The children of a node merge along z, then y, then x, so a node has up to seven pairs:

    slot 0          along z   its lower and its upper half
    slots 1, 2      along y   in its lower and in its upper half
    slots 3 to 6    along x   3 + y + 2z

A pair exists if both of its halves have children. Row 0 of the coefficients is the sum of all. The pairs follow level
by level: first slot 0 of all nodes in order, then slots 1 and 2 node by node, then slots 3 to 6.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake.kernels.coding.topology import NONE, MaskNodes, Masks, child, nodes_of
from nerfbake.kernels.jit import compiled

Rows = npt.NDArray[np.int32]
REFERENCES = 4
AXES = np.array([2, 1, 1, 0, 0, 0, 0])  # of each slot


class CoefficientPairs(NamedTuple):
    """Slots and references of the m rows of coefficients:

    slot        (m,) uint8 the pair's slot in its node
    references  (m, 4) int32 rows; 0 for none, because the sum is never a reference
                0, 1, 2  the pair of the same axis that touches this one at -x, -y, -z
                3        the pair of the same axis that contains this one, of the nearest node above that has one
    """

    slot: npt.NDArray[np.uint8]
    references: Rows


def pairs_of(masks: Masks, m: int) -> CoefficientPairs:
    """The pairs of valid masks with m leaves."""
    pairs = CoefficientPairs(np.zeros(m, np.uint8), np.zeros((m, REFERENCES), np.int32))
    c, own = len(masks), masks.copy()  # numba compiles read-only arrays separately
    _find(own, nodes_of(own), np.zeros((c, 7), np.int32), np.zeros((c, 3), np.int32), pairs)
    return pairs


@compiled()
def _find(masks: Masks, nodes: MaskNodes, rows: Rows, above: Rows, pairs: CoefficientPairs) -> None:
    """rows (c, 7): the row of each slot, 0 for none; above (c, 3): the pair of each axis that contains the node."""
    begin, row = 0, 1
    while begin < len(masks):
        end = begin
        while end < len(masks) and nodes.level[end] == nodes.level[begin]:
            end += 1
        for slots in ((0, 1), (1, 3), (3, 7)):
            for node in range(begin, end):
                for slot in range(slots[0], slots[1]):
                    if _halves(masks[node], slot):
                        rows[node, slot], pairs.slot[row] = row, slot
                        row += 1
        for node in range(begin, end):
            for slot in range(7):
                if rows[node, slot]:
                    _refer(nodes.beside[node], node, slot, rows, above, pairs.references)
            for octant in range(8):
                below = child(masks, nodes, node, octant)
                if below != NONE and below < len(masks):
                    for axis in range(3):
                        own = rows[node, (3 + (octant >> 1), 1 + (octant >> 2), 0)[axis]]
                        above[below, axis] = own if own else above[node, axis]
        begin = end


@compiled()
def _halves(mask: int, slot: int) -> bool:
    """Whether both halves of a pair have children."""
    if slot == 0:
        return mask & 15 != 0 and mask & 240 != 0
    if slot < 3:
        part = mask >> 4 * (slot - 1)
        return part & 3 != 0 and part & 12 != 0
    return mask >> 2 * (slot - 3) & 3 == 3


@compiled()
def _refer(beside: Rows, node: int, slot: int, rows: Rows, above: Rows, references: Rows) -> None:
    own = references[rows[node, slot]]
    axis, first = AXES[slot], (0, 1, 3)[2 - AXES[slot]]
    for side in range(3):
        # Pairs inside the same node are adjacent along the axes above the pair's axis.
        bit = 1 << side - axis - 1 if side > axis else 0
        inside = bit and slot - first & bit
        near = node if inside else beside[side]
        if near != NONE:
            own[side] = rows[near, first + (slot - first ^ bit)]
    own[3] = above[node, axis]
