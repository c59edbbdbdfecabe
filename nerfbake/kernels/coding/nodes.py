"""The nodes behind child masks, breadth-first: who is whose child, and who stands beside whom.

Every node above the level of single voxels has a mask; bit o is set where it has a child in octant o = x + 2y + 4z.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake.kernels.jit import compiled

Masks = npt.NDArray[np.uint8]
Numbers = npt.NDArray[np.int32]

NONE = -1  # in place of a node's number
BITS = np.array([bin(mask).count("1") for mask in range(256)], np.int32)


class Nodes(NamedTuple):
    """Of c nodes that have masks, as far as the masks are known.

    first   (c,) int32 the number of its first child; children stand one behind the other
    level   (c,) int32 0 for the root
    beside  (c, 6) int32 the nodes of the same level at -x, -y, -z, +x, +y, +z, or NONE
    parent  (c,) int32, 0 for the root
    octant  (c,) int32 which child of its parent it is
    """

    first: Numbers
    level: Numbers
    beside: Numbers
    parent: Numbers
    octant: Numbers


def new_nodes(c: int) -> Nodes:
    """Room for so many; the root stands alone."""
    numbers = np.zeros((4, c), np.int32)
    return Nodes(numbers[0], numbers[1], np.full((c, 6), NONE, np.int32), numbers[2], numbers[3])


def nodes_of(masks: Masks) -> Nodes:
    """The nodes behind sound masks."""
    nodes = new_nodes(len(masks))
    _connect_all(masks, nodes)
    return nodes


@compiled()
def _connect_all(masks: Masks, nodes: Nodes) -> None:
    count = 1
    for node in range(len(masks)):
        meet(masks, nodes, node)
        count = add_children(masks, nodes, node, count)


@compiled(merged=True)
def child(masks: Masks, nodes: Nodes, node: int, octant: int) -> Any:
    """The number of a node's child, or NONE. Its mask must be known."""
    mask = masks[node]
    if not mask >> octant & 1:
        return NONE
    return nodes.first[node] + BITS[mask & ((1 << octant) - 1)]


@compiled(merged=True)
def add_children(masks: Masks, nodes: Nodes, node: int, count: int) -> int:
    """Numbers the children of a node whose mask is known; count and what comes back is how many nodes there are."""
    nodes.first[node] = count
    for octant in range(8):
        if masks[node] >> octant & 1:
            if count < len(masks):
                nodes.parent[count], nodes.octant[count] = node, octant
                nodes.level[count] = nodes.level[node] + 1
            count += 1
    return count


@compiled(merged=True)
def meet(masks: Masks, nodes: Nodes, node: int) -> None:
    """Finds who stands beside a node; the masks of the level above must be known."""
    if node == 0:
        return
    parent, octant = nodes.parent[node], nodes.octant[node]
    for axis in range(3):
        upper = octant >> axis & 1
        # On one side there is its parent's other child, on the other side a child of who stands beside the parent.
        inner, outer = (axis, axis + 3) if upper else (axis + 3, axis)
        nodes.beside[node, inner] = child(masks, nodes, parent, octant ^ 1 << axis)
        uncle = nodes.beside[parent, outer]
        nodes.beside[node, outer] = NONE if uncle == NONE else child(masks, nodes, uncle, octant ^ 1 << axis)
