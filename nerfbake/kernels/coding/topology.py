"""Coding of child masks, node by node, breadth-first: is it a leaf, and if not, which of its octants have a child?

The context of an octant:

    before   1 << octant | the lower octants of its node that have a child
    faces    bit k: there is a node adjacent to its node at -x, -y, -z, +x, +y, +z
    outside  four to the power of 2, 1, 0 times the state at its outer face along x, y, z:
             0 no node, 1 a node whose mask is not known yet, 2 an octant without a child, 3 one with a child, or a leaf

The context of a node: its level (15 at most), and how many of the adjacent nodes are known to be leaves (3 at most).

MaskNodes are the nodes of child masks, breadth-first: their children, parents and neighbours. Every node above the
level of single voxels has a mask; bit o is set if it has a child in octant o = x + 2y + 4z.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake.kernels.coding.range_coder import Bytes, Coder, Mixer, consumed, decoder, encoder, finish, mix_bit, mixer
from nerfbake.kernels.jit import compiled

Masks = npt.NDArray[np.uint8]
Numbers = npt.NDArray[np.int32]

NONE = -1  # in place of a node number
BITS = np.array([bin(mask).count("1") for mask in range(256)], np.int32)


class MaskNodes(NamedTuple):
    """The c nodes that have masks, as far as the masks are known.

    first   (c,) int32 the number of its first child; children are consecutive
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


def new_nodes(c: int) -> MaskNodes:
    """Allocate c nodes. The root has no neighbours."""
    numbers = np.zeros((4, c), np.int32)
    return MaskNodes(numbers[0], numbers[1], np.full((c, 6), NONE, np.int32), numbers[2], numbers[3])


def nodes_of(masks: Masks) -> MaskNodes:
    """The nodes of valid masks."""
    nodes = new_nodes(len(masks))
    _connect_all(masks, nodes)
    return nodes


@compiled()
def _connect_all(masks: Masks, nodes: MaskNodes) -> None:
    count = 1
    for node in range(len(masks)):
        find_neighbours(masks, nodes, node)
        count = add_children(masks, nodes, node, count)


@compiled(merged=True)
def child(masks: Masks, nodes: MaskNodes, node: int, octant: int) -> Any:
    """The number of a node's child, or NONE. The mask of the node must be known."""
    mask = masks[node]
    if not mask >> octant & 1:
        return NONE
    return nodes.first[node] + BITS[mask & ((1 << octant) - 1)]


@compiled(merged=True)
def add_children(masks: Masks, nodes: MaskNodes, node: int, count: int) -> int:
    """Number the children of a node whose mask is known.

    count: the number of nodes so far. Returns the new number.
    """
    nodes.first[node] = count
    for octant in range(8):
        if masks[node] >> octant & 1:
            if count < len(masks):
                nodes.parent[count], nodes.octant[count] = node, octant
                nodes.level[count] = nodes.level[node] + 1
            count += 1
    return count


@compiled(merged=True)
def find_neighbours(masks: Masks, nodes: MaskNodes, node: int) -> None:
    """Find the neighbours of a node. The masks of the level above must be known."""
    if node == 0:
        return
    parent, octant = nodes.parent[node], nodes.octant[node]
    for axis in range(3):
        upper = octant >> axis & 1
        # On one side is a sibling, on the other side a child of the parent's neighbour.
        inner, outer = (axis, axis + 3) if upper else (axis + 3, axis)
        nodes.beside[node, inner] = child(masks, nodes, parent, octant ^ 1 << axis)
        uncle = nodes.beside[parent, outer]
        nodes.beside[node, outer] = NONE if uncle == NONE else child(masks, nodes, uncle, octant ^ 1 << axis)


SOUND, ORPHAN, DEEP = range(3)  # status of decoded masks
_ROOM = 4096
_VALUES, _SETS = 1 << 14, 9
_LEAF = 8  # weight set of the leaf decision; the octants use sets 0 to 7


def encode_masks(masks: Masks) -> Bytes:
    """Encode valid masks."""
    masks = masks.copy()  # _code() writes the masks that it reads
    room = _ROOM + len(masks)
    while True:
        coder = encoder(room)
        _code(masks, new_nodes(len(masks)), coder, mixer(_VALUES, _SETS), 0)
        if (size := finish(coder)) <= room:
            return coder.data[:size]
        room = size


def decode_masks(data: Bytes, c: int, levels: int) -> tuple[Masks, int, int]:
    """Decode the masks of c nodes in this number of levels.

    Returns the masks, the status (SOUND, ORPHAN or DEEP), and the number of bytes read.
    """
    masks, coder = np.zeros(c, np.uint8), decoder(data)
    found = _code(masks, new_nodes(c), coder, mixer(_VALUES, _SETS), levels)
    return masks, found, consumed(coder)


@compiled()
def _code(masks: Masks, nodes: MaskNodes, coder: Coder, mixer: Mixer, levels: int) -> int:
    """Encode or decode all masks. Decoded nodes are checked immediately. Returns SOUND, ORPHAN or DEEP."""
    count = 1
    for node in range(len(masks)):
        if node == count:
            return ORPHAN
        if levels and nodes.level[node] >= levels:
            return DEEP
        find_neighbours(masks, nodes, node)
        level = min(nodes.level[node], 15)
        faces, leaves = 0, 0
        for side in range(6):
            near = nodes.beside[node, side]
            if near != NONE:
                faces |= 1 << side
                leaves += near < node and masks[near] == 0
        leaves = min(leaves, 3)
        mask, got = masks[node], 0
        if not mix_bit(coder, mixer, _LEAF, level * 4 + leaves, faces * 4 + leaves, level, leaves, mask == 0):
            for octant in range(8):
                if octant == 7 and got == 0:
                    got = 128  # a node that is not a leaf has at least one child
                    break
                outside, before = _outside(masks, nodes, node, octant), 1 << octant | got
                known = BITS[got]
                one, other = 256 + (octant * 64 + outside) * 8 + known, 64 + (octant * 16 + level) * 8 + known
                bit = mask >> octant & 1
                bit = mix_bit(coder, mixer, octant, before * 64 + faces, one, before * 64 + outside, other, bit)
                got |= bit << octant
        masks[node] = got
        count = add_children(masks, nodes, node, count)
    return SOUND


@compiled(merged=True)
def _outside(masks: Masks, nodes: MaskNodes, node: int, octant: int) -> int:
    """The states at the outer faces of an octant."""
    found = 0
    for axis in range(3):
        near = nodes.beside[node, axis + 3 * (octant >> axis & 1)]
        if near == NONE:
            state = 0
        elif near > node:
            state = 1
        elif masks[near] == 0 or masks[near] >> (octant ^ 1 << axis) & 1:
            state = 3
        else:
            state = 2
        found = 4 * found + state
    return found
