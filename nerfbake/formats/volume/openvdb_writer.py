"""One grid of an OpenVDB file, from its flags to its last leaf.

    u32 flags | metadata | map type | map
    u32 1 | background | u32 tiles | u32 upper nodes | tiles: origin 3 x i32 | value | u8 active
    upper:  origin 3 x i32 | child mask 4096 B | active mask 4096 B | values
    lower:                   child mask  512 B | active mask  512 B | values      behind its upper node
    leaf:                                        active mask   64 B               behind its lower node
    and once more each leaf: active mask 64 B | values

    values = u8 0 (those of active voxels; the rest is background) | data
    data   = f32 or f16 as they are; zipped: i64 size | zlib stream, or i64 -size | bytes, where zlib does not help

An empty zipped f32 array is an i64 0, an empty f16 array is nothing at all. openvdb_values has the codes other than 0.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake.formats.volume.frame import NAME, frame_text
from nerfbake.formats.wire.openvdb_packer import NodeValues, Packer
from nerfbake.formats.wire.openvdb_stream import ACTIVE_MASK, ACTIVE_ONLY, ZIP, text
from nerfbake.kernels.arrays import Ints, Words
from nerfbake.kernels.parallel import over_chunks
from nerfbake.kernels.vdb.bitmask import exclusive_sum, popcount
from nerfbake.kernels.vdb.runs import reduce_runs, rows_of_runs
from nerfbake.scene.vdb import VdbTree
from nerfbake.scene.vdb_topology import VdbTopology
from nerfbake.scene.volume import OctreeFrame

TYPES = {
    (1, "float32"): "Tree_float_5_4_3",
    (1, "float16"): "Tree_float_5_4_3_HalfFloat",
    (3, "float32"): "Tree_vec3s_5_4_3",
    (3, "float16"): "Tree_vec3s_5_4_3_HalfFloat",
}
_CHUNK = 256  # leaves packed at a time by each core
Bytes = npt.NDArray[np.uint8]


class Written(NamedTuple):
    """A grid's tree, in the two parts that the file keeps apart."""

    front: list[bytes | memoryview]  # up to the last mask
    buffers: list[bytes | memoryview]


def write_grid(
    grid: VdbTree, transform: npt.NDArray[np.float64], frame: OctreeFrame | None, *, zipped: bool
) -> Written:
    """The grid's bytes. Nodes stand in the order of their signed coordinates, unlike NanoVDB's."""
    order, pack = _Order(grid.topology), Packer(zipped, grid.values.dtype == np.float16)
    tiles, background = _root_tiles(grid), _background(grid).tobytes()
    counts = struct.pack("<II", len(grid.topology.tiles.root_origin) if grid.topology.tiles else 0, len(order.upper))
    front: list[bytes | memoryview] = [
        struct.pack("<I", ACTIVE_MASK | (ZIP if zipped else 0)),
        _metadata(grid, frame),
        _map(transform),
        struct.pack("<I", 1) + background + counts + tiles,
        _masks(grid, order, pack).data,
    ]
    return Written(front, _buffers(grid, order, pack))


class _Order:
    """The order of nodes in the file, as rows of the topology's: only that of the root's tiles differs."""

    def __init__(self, topology: VdbTopology) -> None:
        x, y, z = topology.root_origin.T
        self.upper: Ints = np.lexsort((z, y, x))
        self.lower = rows_of_runs(popcount(topology.upper_mask), self.upper)
        self.leaf = rows_of_runs(popcount(topology.lower_mask), self.lower)


# -- what stands before the tree -------------------------------------------------------------------------------
def _metadata(grid: VdbTree, frame: OctreeFrame | None) -> bytes:
    half = grid.values.dtype == np.float16
    entries = {"is_saved_as_half_float": ("bool", struct.pack("<B", half)), "name": ("string", grid.name.encode())}
    if grid.grid_class and grid.grid_class != "unknown":
        entries["class"] = ("string", grid.grid_class.encode())
    if grid.values.shape[1] == 3:
        entries["vector_type"] = ("string", b"invariant")
    active = grid.active_topology
    if (box := active.box) is not None:
        for name, corner in zip(("file_bbox_min", "file_bbox_max"), box, strict=True):
            entries[name] = ("vec3i", corner.astype("<i4").tobytes())
    entries["file_voxel_count"] = ("int64", struct.pack("<q", active.voxel_count))
    if frame is not None:
        entries[NAME] = ("string", frame_text(frame).encode())
    packed = [text(name) + text(kind) + text(value) for name, (kind, value) in entries.items()]
    return struct.pack("<I", len(packed)) + b"".join(packed)


def _map(transform: npt.NDArray[np.float64]) -> bytes:
    """The simplest of OpenVDB's maps that says it: scales alone, or any affine one."""
    mat, vec = transform[:, :3], transform[:, 3]
    scale = np.diag(mat)
    if (mat != np.diag(scale)).any() or not (scale > 0).all():
        # OpenVDB multiplies row vectors: its matrix is ours on its side, the translation its last row.
        square = np.eye(4)
        square[:3, :3], square[3, :3] = mat.T, vec
        return text("AffineMap") + square.astype("<f8").tobytes()
    kind = "UniformScaleTranslateMap" if len(set(scale.tolist())) == 1 else "ScaleTranslateMap"
    rows = np.stack([vec, scale, scale, 1 / scale, 1 / scale**2, 0.5 / scale])
    return text(kind) + rows.astype("<f8").tobytes()


def _background(grid: VdbTree) -> npt.NDArray[np.float32]:
    return grid.background.astype(grid.values.dtype).astype("<f4")


def _root_tiles(grid: VdbTree) -> bytes:
    if grid.topology.tiles is None:
        return b""
    dtype = np.dtype([("origin", "<i4", 3), ("value", "<f4", grid.values.shape[1]), ("active", "u1")])
    origin = grid.topology.tiles.root_origin
    tiles, start = np.zeros(len(origin), dtype), grid.topology.count - len(origin)
    tiles["origin"], tiles["value"] = origin, grid.values[start:]
    tiles["active"] = True if grid.active is None else grid.active[start:]
    return tiles.tobytes()


# -- the tree --------------------------------------------------------------------------------------------------
def _masks(grid: VdbTree, order: _Order, pack: Packer) -> Bytes:
    """All nodes' masks and tiles, each node's before its children's: every size is known, so every place is."""
    topology = grid.topology
    upper = _Inner(grid, "upper_mask", order.upper, sum(topology.tile_counts[:1]), pack)
    lower = _Inner(grid, "lower_mask", order.lower, 0, pack)
    leaves, lowers = popcount(lower.children), popcount(upper.children)
    lower_total = lower.sizes + 64 * leaves
    # Before a lower node stand all lower nodes before it, and the upper ones up to its own.
    upper_size = 12 + upper.sizes
    lower_at = exclusive_sum(lower_total) + np.repeat(np.cumsum(upper_size), lowers)
    upper_at = exclusive_sum(upper_size + reduce_runs(np.add, lower_total, lowers, 0))
    leaf_at = 64 * np.arange(len(topology.leaf_mask))
    leaf_at += np.repeat(lower_at + lower.sizes - 64 * exclusive_sum(leaves), leaves)
    out = np.zeros(int(lower_total.sum() + upper_size.sum()), np.uint8)
    _put(out, upper_at, np.ascontiguousarray(topology.root_origin[order.upper], "<i4").view(np.uint8))
    upper.put(out, upper_at + 12)
    lower.put(out, lower_at)
    _put(out, leaf_at, _octets(grid.active_topology.leaf_mask[order.leaf]))
    return out


class _Inner:
    """A level's inner nodes in the file's order: children (p, w), sizes (p,) in bytes."""

    def __init__(self, grid: VdbTree, name: str, order: Ints, start: int, pack: Packer) -> None:
        topology, live = grid.topology, grid.active_topology.tiles
        self.children: Words = getattr(topology, name)[order]
        self._active: Words = getattr(live, name)[order] if live else np.zeros_like(self.children)
        nothing = struct.pack("<B", ACTIVE_ONLY) + pack(b"")
        self._nothing = np.frombuffer(nothing, np.uint8)
        self._stored: dict[int, bytes] = {}
        if topology.tiles is not None:
            held = getattr(topology.tiles, name)[order]
            first, counts = topology.m + start, popcount(getattr(topology.tiles, name))
            values = grid.values[first + rows_of_runs(counts, order)]
            nodes = NodeValues(held, self._active, self.children, values, grid.background)
            self._stored = {int(i): nodes.stored(int(i), pack) for i in np.flatnonzero(held.any(axis=1))}
        self.sizes = np.full(len(order), 2 * 8 * self.children.shape[1] + len(nothing))
        for i, stored in self._stored.items():
            self.sizes[i] += len(stored) - len(nothing)

    def put(self, out: Bytes, at: Ints) -> None:
        """Child masks, masks of active tiles and values, each node's from its place on."""
        size = 8 * self.children.shape[1]
        _put(out, at, _octets(self.children))
        _put(out, at + size, _octets(self._active))
        plain = np.ones(len(at), bool)
        for i, stored in self._stored.items():
            plain[i] = False
            out[at[i] + 2 * size : at[i] + 2 * size + len(stored)] = np.frombuffer(stored, np.uint8)
        _put(out, at[plain] + 2 * size, np.broadcast_to(self._nothing, (int(plain.sum()), len(self._nothing))))


def _put(out: Bytes, at: Ints, rows: Bytes) -> None:
    out[at[:, None] + np.arange(rows.shape[1])] = rows


def _octets(masks: Words) -> Bytes:
    return np.ascontiguousarray(masks, "<u8").view(np.uint8)


def _buffers(grid: VdbTree, order: _Order, pack: Packer) -> list[bytes | memoryview]:
    """Masks and values of all leaves. Each leaf is a zlib stream of its own, so zlib is called leaf by leaf."""
    topology, values = grid.topology, grid.values[: grid.topology.m]
    masks = _octets(grid.active_topology.leaf_mask[order.leaf]).tobytes()
    pieces: list[bytes | memoryview] = [b""] * len(order.leaf)
    if grid.active is None:
        stored = _active_leaves(topology, values, order, pack)
    else:
        nodes = NodeValues(topology.leaf_mask, grid.active_topology.leaf_mask, None, values, grid.background)
        rows = order.leaf.tolist()

        def stored(leaf: int) -> bytes:
            return nodes.stored(rows[leaf], pack)

    def work(begin: int, end: int) -> None:
        pieces[begin] = b"".join(masks[64 * i : 64 * i + 64] + stored(i) for i in range(begin, end))

    over_chunks(work, len(order.leaf), _CHUNK)
    return [piece for piece in pieces if piece]


def _active_leaves(
    topology: VdbTopology, values: npt.NDArray[Any], order: _Order, pack: Packer
) -> Callable[[int], bytes]:
    """What a leaf of active voxels stores: the rule, and a third of the time of NodeValues."""
    counts, first = popcount(topology.leaf_mask)[order.leaf], topology.first[order.leaf]
    raw = np.ascontiguousarray(values, values.dtype.newbyteorder("<")).reshape(-1).view(np.uint8).data
    width, code = values.itemsize * values.shape[1], struct.pack("<B", ACTIVE_ONLY)
    ends = list(zip((first * width).tolist(), ((first + counts) * width).tolist(), strict=True))
    return lambda leaf: code + pack(raw[slice(*ends[leaf])])
