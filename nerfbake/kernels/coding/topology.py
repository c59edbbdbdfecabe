"""Child masks, coded node by node, breadth-first: is it a leaf, and if not, which of its octants have a child?

What is known of an octant when it is its turn:

    before   1 << octant | the lower octants of its node that have a child
    faces    bit k: there is a node beside its own at -x, -y, -z, +x, +y, +z
    outside  four to the power of 2, 1, 0 times what touches it at its outer face along x, y, z:
             0 no node, 1 a node whose mask is not known yet, 2 an octant without a child, 3 one with a child, or a leaf

Of a node: its level (15 at most), and how many of those beside it are known to be leaves (3 at most).
"""

from __future__ import annotations

import numpy as np

from nerfbake.kernels.coding.nodes import BITS, NONE, Masks, Nodes, add_children, meet, new_nodes
from nerfbake.kernels.coding.range_coder import (
    Bytes,
    Coder,
    Mixer,
    consumed,
    decoder,
    encoder,
    finish,
    mix_bit,
    mixer,
)
from nerfbake.kernels.jit import compiled

SOUND, ORPHAN, DEEP = range(3)  # what may be wrong with masks that are decoded
_ROOM = 4096
_VALUES, _SETS = 1 << 14, 9
_LEAF = 8  # its set of weights; the octants have 0 to 7


def encode_masks(masks: Masks) -> Bytes:
    """The bytes of sound masks."""
    masks = masks.copy()  # coding writes what it has read
    room = _ROOM + len(masks)
    while True:
        coder = encoder(room)
        _code(masks, new_nodes(len(masks)), coder, mixer(_VALUES, _SETS), 0)
        if (size := finish(coder)) <= room:
            return coder.data[:size]
        room = size


def decode_masks(data: Bytes, c: int, levels: int) -> tuple[Masks, int, int]:
    """c masks of nodes in so many levels, what is wrong with them, if anything is, and how many bytes they took."""
    masks, coder = np.zeros(c, np.uint8), decoder(data)
    found = _code(masks, new_nodes(c), coder, mixer(_VALUES, _SETS), levels)
    return masks, found, consumed(coder)


@compiled()
def _code(masks: Masks, nodes: Nodes, coder: Coder, mixer: Mixer, levels: int) -> int:
    """Codes or decodes all masks; the nodes that are decoded are checked as they come. SOUND, or what is wrong."""
    count = 1
    for node in range(len(masks)):
        if node == count:
            return ORPHAN
        if levels and nodes.level[node] >= levels:
            return DEEP
        meet(masks, nodes, node)
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
                    got = 128  # it has a child somewhere
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
def _outside(masks: Masks, nodes: Nodes, node: int, octant: int) -> int:
    """What touches an octant from outside of its node."""
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
