"""Write one grid of an OpenVDB file, from its flags to its last leaf.

    u32 flags | metadata | map type | map
    u32 1 | background | u32 tiles | u32 upper nodes | tiles: origin 3 x i32 | value | u8 active
    upper:  origin 3 x i32 | child mask 4096 B | active mask 4096 B | values
    lower:                   child mask  512 B | active mask  512 B | values      after its upper node
    leaf:                                        active mask   64 B               after its lower node
    then again for each leaf: active mask 64 B | values

    values = u8 0 (active voxels only; all others are background) | data
    data   = f32 or f16 uncompressed; zipped: i64 size | zlib stream, or i64 -size | bytes if zlib does not help

An empty zipped f32 array is an i64 0, an empty f16 array is zero bytes. Codes other than 0: wire/openvdb.py.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake.formats.volume.frame import NAME, frame_text
from nerfbake.formats.wire.deflate import deflate
from nerfbake.formats.wire.openvdb import ACTIVE_MASK, ACTIVE_ONLY, ALL_VALUES, ZIP, text
from nerfbake.kernels.arrays import Bits, Ints, Words
from nerfbake.kernels.parallel import over_chunks
from nerfbake.kernels.vdb.bitmask import bits_of, exclusive_sum, popcount, reduce_runs, rows_of_runs
from nerfbake.scene.vdb import VdbTree
from nerfbake.scene.vdb_topology import VdbTopology
from nerfbake.scene.volume import OctreeFrame

MINUS, CHOSEN = 1, 3  # codes: inactive voxels are minus the background; a mask selects this or the background


class Packer(NamedTuple):
    """Compress data if `zipped`, in OpenVDB's layout."""

    zipped: bool
    half: bool

    def __call__(self, data: bytes | memoryview) -> bytes | memoryview:
        if not self.zipped or (self.half and not len(data)):
            return data
        return _zipped(data)


class NodeValues:
    """The stored values of a run of nodes: a code for each node, and its data.

    held (p, w): mask of the slots with stored values
    active (p, w): mask of the active slots among them
    children (p, w): mask of the slots that are nodes
    values (q, c): values of the held slots, node by node
    """

    def __init__(
        self, held: Words, active: Words, children: Words | None, values: npt.NDArray[Any], background: Any
    ) -> None:
        self._held, self._active, self._background = held, active, background
        self._values = np.ascontiguousarray(values, values.dtype.newbyteorder("<"))
        self._first = np.append(exclusive_sum(counts := popcount(held)), counts.sum())
        self._is_active: Bits = bits_of(active)[bits_of(held)]
        minus = self._is_active | (self._values == -background.astype(values.dtype)).all(axis=1)
        other = ~reduce_runs(np.logical_and, minus, counts, True)
        everywhere = (held | (0 if children is None else children)) == ~np.uint64(0)
        inactive = (held & ~active).any(axis=1)
        self.code = np.where(inactive, np.where(everywhere.all(axis=1), MINUS, CHOSEN), ACTIVE_ONLY)
        self.code[other] = ALL_VALUES

    def stored(self, node: int, pack: Packer) -> bytes:
        """Return the code of a node and its data."""
        code, run = int(self.code[node]), slice(self._first[node], self._first[node + 1])
        values = self._values[run]
        if code == ALL_VALUES:
            slots = bits_of(self._held[node])
            dense = np.zeros((len(slots), values.shape[1]), values.dtype)
            dense[:] = self._background
            dense[slots] = values
            values = dense
        else:
            values = values[self._is_active[run]]
        mask = (~(self._held[node] & ~self._active[node])).astype("<u8").tobytes() if code == CHOSEN else b""
        return struct.pack("<B", code) + mask + pack(np.ascontiguousarray(values).reshape(-1).view(np.uint8).data)


def _zipped(data: bytes | memoryview) -> bytes:
    packed = deflate(data)
    if len(packed) < len(data):
        return struct.pack("<q", len(packed)) + packed
    return struct.pack("<q", -len(data)) + data


TYPES = {
    (1, "float32"): "Tree_float_5_4_3",
    (1, "float16"): "Tree_float_5_4_3_HalfFloat",
    (3, "float32"): "Tree_vec3s_5_4_3",
    (3, "float16"): "Tree_vec3s_5_4_3_HalfFloat",
}
_CHUNK = 256  # leaves compressed at a time by each core
Bytes = npt.NDArray[np.uint8]


class Written(NamedTuple):
    """The two parts of a grid in the file."""

    front: list[bytes | memoryview]  # everything up to the last mask
    buffers: list[bytes | memoryview]


def write_grid(
    grid: VdbTree, transform: npt.NDArray[np.float64], frame: OctreeFrame | None, *, zipped: bool
) -> Written:
    """Write a grid. Unlike in NanoVDB, nodes are in the order of their signed coordinates."""
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
    """The order of nodes in the file, as rows of the topology. Only the order of the root's tiles differs."""

    def __init__(self, topology: VdbTopology) -> None:
        x, y, z = topology.root_origin.T
        self.upper: Ints = np.lexsort((z, y, x))
        self.lower = rows_of_runs(popcount(topology.upper_mask), self.upper)
        self.leaf = rows_of_runs(popcount(topology.lower_mask), self.lower)


# -- before the tree -------------------------------------------------------------------------------------------
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
    """Write the simplest of OpenVDB's maps that represents the transform: scale and translation, or affine."""
    mat, vec = transform[:, :3], transform[:, 3]
    scale = np.diag(mat)
    if (mat != np.diag(scale)).any() or not (scale > 0).all():
        # OpenVDB multiplies row vectors: its matrix is the transpose, with the translation in the last row.
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
    """Write masks and tiles of all nodes, each node before its children. All sizes, hence all offsets, are known."""
    topology = grid.topology
    upper = _Inner(grid, "upper_mask", order.upper, sum(topology.tile_counts[:1]), pack)
    lower = _Inner(grid, "lower_mask", order.lower, 0, pack)
    leaves, lowers = popcount(lower.children), popcount(upper.children)
    lower_total = lower.sizes + 64 * leaves
    # The offset of a lower node is the size of all earlier lower nodes plus the upper nodes up to its parent.
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
    """The inner nodes of a level in the order of the file: children (p, w), sizes (p,) in bytes."""

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
        """Write child mask, mask of active tiles and values of each node at its offset."""
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
    """Encode masks and values of all leaves. Each leaf is a separate zlib stream, so zlib is called for each leaf."""
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
    """Encode leaves that contain only active voxels, the common case, in a third of the time of NodeValues."""
    counts, first = popcount(topology.leaf_mask)[order.leaf], topology.first[order.leaf]
    raw = np.ascontiguousarray(values, values.dtype.newbyteorder("<")).reshape(-1).view(np.uint8).data
    width, code = values.itemsize * values.shape[1], struct.pack("<B", ACTIVE_ONLY)
    ends = list(zip((first * width).tolist(), ((first + counts) * width).tolist(), strict=True))
    return lambda leaf: code + pack(raw[slice(*ends[leaf])])
