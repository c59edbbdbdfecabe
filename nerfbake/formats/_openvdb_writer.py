"""One grid of an OpenVDB file, from its flags to its last leaf.

    u32 flags | metadata | map type | map
    u32 1 | background | u32 tiles = 0 | u32 upper nodes
    upper:  origin 3 x i32 | child mask 4096 B | active mask 4096 B | values
    lower:                   child mask  512 B | active mask  512 B | values      behind its upper node
    leaf:                                        active mask   64 B               behind its lower node
    and once more each leaf: active mask 64 B | values

    values = u8 0 (those of active voxels; the rest is background) | data
    data   = f32 or f16 as they are; zipped: i64 size | zlib stream, or i64 -size | bytes, where zlib does not help

An empty zipped f32 array is an i64 0, an empty f16 array is nothing at all.
"""

from __future__ import annotations

import struct
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake.formats._deflate import deflate
from nerfbake.formats._openvdb_stream import ACTIVE_MASK, ACTIVE_ONLY, ZIP, text
from nerfbake.formats._vdb_frame import NAME, frame_text
from nerfbake.kernels.bitmask import Ints, Words, exclusive_sum, popcount
from nerfbake.kernels.parallel import over_chunks
from nerfbake.kernels.runs import reduce_runs, rows_of_runs
from nerfbake.scene.vdb import VdbTopology, VdbTree
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
    front: list[bytes | memoryview]  # up to the last mask
    buffers: list[bytes | memoryview]


def write_grid(
    grid: VdbTree, transform: npt.NDArray[np.float64], frame: OctreeFrame | None, *, zipped: bool
) -> Written:
    """The grid's bytes. Nodes stand in the order of their signed coordinates, unlike NanoVDB's."""
    order = _Order(grid.topology)
    half = grid.values.dtype == np.float16
    flags = ACTIVE_MASK | (ZIP if zipped else 0)
    empty_values = struct.pack("<B", ACTIVE_ONLY) + (bytes(8) if zipped and not half else b"")
    background = grid.background.astype(grid.values.dtype).astype("<f4").tobytes()
    front: list[bytes | memoryview] = [
        struct.pack("<I", flags),
        _metadata(grid, frame, half),
        _map(transform),
        struct.pack("<I", 1) + background + struct.pack("<II", 0, len(order.upper)),
        _masks(grid.topology, order, empty_values).data,
    ]
    return Written(front, _buffers(grid, order, zipped=zipped))


class _Order:
    """The order of nodes in the file, as rows of the topology's: only that of the root's tiles differs."""

    def __init__(self, topology: VdbTopology) -> None:
        x, y, z = topology.root_origin.T
        self.upper: Ints = np.lexsort((z, y, x))
        self.lower = rows_of_runs(popcount(topology.upper_mask), self.upper)
        self.leaf = rows_of_runs(popcount(topology.lower_mask), self.lower)


# -- what stands before the tree -------------------------------------------------------------------------------
def _metadata(grid: VdbTree, frame: OctreeFrame | None, half: bool) -> bytes:
    entries = {"is_saved_as_half_float": ("bool", struct.pack("<B", half)), "name": ("string", grid.name.encode())}
    if grid.values.shape[1] == 1:
        entries["class"] = ("string", b"fog volume")
    else:
        entries["vector_type"] = ("string", b"invariant")
    if (box := grid.topology.box) is not None:
        for name, corner in zip(("file_bbox_min", "file_bbox_max"), box, strict=True):
            entries[name] = ("vec3i", corner.astype("<i4").tobytes())
    entries["file_voxel_count"] = ("int64", struct.pack("<q", grid.topology.m))
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


# -- the tree --------------------------------------------------------------------------------------------------
def _masks(topology: VdbTopology, order: _Order, empty_values: bytes) -> Bytes:
    """All nodes' masks, each node's before its children's: every size is known, so every place is."""
    active = np.frombuffer(empty_values, np.uint8)
    lower_size, upper_size = 2 * 512 + len(active), 12 + 2 * 4096 + len(active)
    upper_mask, lower_mask = topology.upper_mask[order.upper], topology.lower_mask[order.lower]
    leaves, lowers = popcount(lower_mask), popcount(upper_mask)
    lower_total = lower_size + 64 * leaves
    # Before a lower node stand all lower nodes before it, and the upper ones up to its own.
    lower_at = exclusive_sum(lower_total) + upper_size * (1 + np.repeat(np.arange(len(lowers)), lowers))
    upper_at = exclusive_sum(upper_size + reduce_runs(np.add, lower_total, lowers, 0))
    leaf_at = 64 * np.arange(len(topology.leaf_mask))
    leaf_at += np.repeat(lower_at + lower_size - 64 * exclusive_sum(leaves), leaves)
    out = np.zeros(int(lower_total.sum()) + upper_size * len(lowers), np.uint8)
    _put(out, upper_at, np.ascontiguousarray(topology.root_origin[order.upper], "<i4").view(np.uint8))
    for at, masks, size in ((upper_at + 12, upper_mask, upper_size - 12), (lower_at, lower_mask, lower_size)):
        _put(out, at, _octets(masks))
        _put(out, at + size - len(active), np.broadcast_to(active, (len(at), len(active))))
    _put(out, leaf_at, _octets(topology.leaf_mask[order.leaf]))
    return out


def _put(out: Bytes, at: Ints, rows: Bytes) -> None:
    out[at[:, None] + np.arange(rows.shape[1])] = rows


def _octets(masks: Words) -> Bytes:
    return np.ascontiguousarray(masks, "<u8").view(np.uint8)


def _buffers(grid: VdbTree, order: _Order, *, zipped: bool) -> list[bytes | memoryview]:
    """Masks and values of all leaves. Each leaf is a zlib stream of its own, so zlib is called leaf by leaf."""
    counts = popcount(grid.topology.leaf_mask)[order.leaf]
    first = grid.topology.first[order.leaf]
    values = np.ascontiguousarray(grid.values, grid.values.dtype.newbyteorder("<"))
    raw = values.reshape(-1).view(np.uint8).data
    width = values.itemsize * values.shape[1]
    masks = _octets(grid.topology.leaf_mask[order.leaf]).tobytes()
    ends = list(zip((first * width).tolist(), ((first + counts) * width).tolist(), strict=True))
    pieces: list[bytes | memoryview] = [b""] * len(ends)
    code = struct.pack("<B", ACTIVE_ONLY)
    pack = _zipped if zipped else bytes

    def work(begin: int, end: int) -> None:
        pieces[begin] = b"".join(
            masks[64 * i : 64 * i + 64] + code + pack(raw[slice(*ends[i])]) for i in range(begin, end)
        )

    over_chunks(work, len(ends), _CHUNK)
    return [piece for piece in pieces if piece]


def _zipped(data: memoryview) -> bytes:
    packed = deflate(data)
    if len(packed) < len(data):
        return struct.pack("<q", len(packed)) + packed
    return struct.pack("<q", -len(data)) + data
