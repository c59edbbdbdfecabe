"""The grids of PlenVDB's folder, as .vdb files: those of all nodes, and those of a merged lattice.

A grid that its program has trained is active at every node, in leaves of 8^3 voxels. When it reads one it merges leaves
whose voxels are all equal into tiles, and so it would write it again. Here what has no node with a row is such a tile
of zeros from the start: an empty lattice takes kilobytes, where its leaves would take 4 bytes a channel and node.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake import memory
from nerfbake.formats.volume.openvdb import file_of
from nerfbake.kernels.arrays import Bits, Singles
from nerfbake.kernels.vdb.bitmask import bits_kept, words_of
from nerfbake.scene.vdb import VdbTree
from nerfbake.scene.vdb_tiles import VdbTiles
from nerfbake.scene.vdb_topology import VdbTopology
from nerfbake.scene.vdb_voxels import topology_of, topology_of_leaves
from nerfbake.scene.volume import Transform

_IDENTITY = np.eye(4)[:3]
_LEAF = 8  # voxels along an edge
Links = npt.NDArray[np.int32]
Pieces = Iterator[bytes | memoryview]


class Nodes(NamedTuple):
    """Every node of a lattice as a voxel, or as a part of a tile.

    rows (count,): of the values of a grid those of nodes with a row, which they are; -1 where there is none
    """

    topology: VdbTopology
    rows: Links


def nodes_of(links: Links) -> Nodes:
    """Of links (X, Y, Z). Raises MemoryLimit."""
    blocks = tuple(-(-edge // _LEAF) for edge in links.shape)
    whole = [(0, blocks[axis] * _LEAF - links.shape[axis]) for axis in range(3)]
    memory.hold("the nodes as voxels", 2 * links.size)
    inside = _blocks(np.pad(np.ones(links.shape, bool), whole))
    held = _blocks(np.pad(links >= 0, whole))
    low = np.stack(np.unravel_index(np.arange(len(inside)), blocks), axis=1) * _LEAF
    topology, order = topology_of_leaves(low, words_of(inside))
    # A leaf that is a node of the tree, and not a tile: it holds something, or reaches beyond the box.
    leaf: Bits = np.asarray(held.any(axis=1) | ~inside.all(axis=1))[order]
    none = np.zeros_like(topology.upper_mask), np.zeros((0, 3), np.int32)
    tiles = VdbTiles(bits_kept(topology.lower_mask, ~leaf), *none)
    masks = topology.upper_mask, bits_kept(topology.lower_mask, leaf), topology.leaf_mask[leaf]
    topology = VdbTopology(topology.root_origin, *masks, tiles)
    memory.hold("the nodes as voxels", 20 * topology.m)
    rows = np.full(topology.count, -1, np.int32)
    rows[: topology.m] = links[tuple(topology.coords.T)]
    return Nodes(topology, rows)


def _blocks(nodes: Bits) -> Bits:
    """(b, 512) the voxels of blocks of 8^3, of nodes whose edges are multiples of 8."""
    x, y, z = (edge // _LEAF for edge in nodes.shape)
    return nodes.reshape(x, _LEAF, y, _LEAF, z, _LEAF).transpose(0, 2, 4, 1, 3, 5).reshape(x * y * z, -1)


def grids_file(nodes: Nodes, channels: int, count: int, columns: Callable[[int], npt.NDArray[np.generic]]) -> Pieces:
    """A file of `count` grids of 1 or 3 channels: columns(k) gives the rows' values (n, channels) of grid k, which is
    made when the file comes to it."""

    def trees() -> Iterator[tuple[VdbTree, Transform]]:
        held = nodes.rows >= 0
        for k in range(count):
            with memory.lent("a grid's values", 4 * channels * len(nodes.rows)):
                values = np.zeros((len(nodes.rows), channels), np.float32)
                values[held] = columns(k)[nodes.rows[held]]
                yield _unnamed(k, nodes.topology, values), _IDENTITY

    return file_of(trees(), count)


def rows_file(mask: Bits) -> Pieces:
    """mergedidxs.vdb: of each node where the mask is true the number of its row, from 1, x-major."""
    coords = np.argwhere(mask)
    topology, order = topology_of(coords)
    values = (order[:, None] + 1).astype(np.float32)
    return file_of([(_unnamed(0, topology, values), _IDENTITY)], 1)


def _unnamed(k: int, topology: VdbTopology, values: Singles) -> VdbTree:
    """A grid without a name, as OpenVDB writes it: its number behind a byte that names cannot hold."""
    return VdbTree(f"\x1e{k}", topology, values, np.zeros(values.shape[1], np.float32), "unknown")
