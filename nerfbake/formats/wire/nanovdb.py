"""The structs of NanoVDB files, 32.3 to 32.9, as NumPy dtypes, and the values of their nodes.

Leaves contain values, or codes between the leaf's minimum and maximum. Source: docs/formats/vdb.md, "NanoVDB files".
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake.errors import MemoryLimit
from nerfbake.formats.wire.vdb_values import StoredValues, concatenate, differs_from_background
from nerfbake.kernels.arrays import Bits, Ints
from nerfbake.kernels.maths.elementary import cast
from nerfbake.kernels.parallel import over_chunks
from nerfbake.kernels.vdb.bitmask import bits_of, words_of

_CHUNK = 256  # leaves that a core decodes at a time
Nodes = npt.NDArray[Any]


class LeafCodes(NamedTuple):
    """The offset of each leaf and, for FpN, its bits per code; 0 for types whose leaf struct contains all values."""

    at: Ints
    bits: Ints


class ValueBudget:
    """A memory limit for decoded values, shared by threads: other threads do not see this thread's memory limit."""

    def __init__(self, most: int) -> None:
        self._most, self._taken = most, 0

    def take(self, size: int) -> None:
        self._taken += size
        if self._taken > self._most:
            raise MemoryLimit("the grid", self._taken, self._most)


def root_tiles_of(entries: Nodes, background: npt.NDArray[np.float32]) -> StoredValues:
    values, active = _floats(entries["value"]), entries["state"] != 0
    own = active | differs_from_background(values, background)
    return StoredValues(own.astype(np.uint64), values[own], active[own])


def tiles_of(nodes: Nodes, layout: Layout, background: npt.NDArray[np.float32], room: ValueBudget) -> StoredValues:
    """Return the tiles of inner nodes. Nodes are read one at a time: a table has up to half a megabyte."""
    mask = np.zeros(nodes["tiles"].shape, np.uint64)
    values, active = [np.zeros((0, layout.channels), np.float32)], [np.zeros(0, bool)]
    for row, node in enumerate(nodes):
        table = _floats(node["table"].view(layout.value)[:, : layout.channels])
        is_active = bits_of(node["tiles"])
        own = (is_active | differs_from_background(table, background)) & ~bits_of(node["children"])
        if own.any():
            mask[row] = words_of(own)
            values.append(table[own])
            active.append(is_active[own])
            room.take(values[-1].nbytes)
    return StoredValues(mask, np.concatenate(values), np.concatenate(active))


def voxels_of(
    view: memoryview,
    leaf: Nodes,
    codes: LeafCodes,
    layout: Layout,
    background: npt.NDArray[np.float32],
    room: ValueBudget,
    *,
    signed: bool,
) -> StoredValues:
    chunks: list[Any] = [None] * -(-len(leaf) // _CHUNK)
    quantised = "quantum" in (layout.leaf.names or ())

    def work(begin: int, end: int) -> None:
        own = leaf[begin:end]
        active = bits_of(own["mask"])
        if quantised:
            bits = codes.bits[begin:end] if layout is FPN else np.full(len(own), BITS[layout.name])
            dense = _decoded(view, own, codes.at[begin:end] + FPN.leaf.itemsize, bits, background, active, signed)
        else:
            dense = _floats(own["values"])
        held = active | differs_from_background(dense, background)
        room.take(int(np.count_nonzero(held)) * 4 * layout.channels)
        chunks[begin // _CHUNK] = StoredValues(words_of(held), dense[held], active[held])

    over_chunks(work, len(leaf), _CHUNK)
    nothing = StoredValues(np.zeros((0, 8), np.uint64), np.zeros((0, layout.channels), np.float32), np.zeros(0, bool))
    return concatenate([nothing, *chunks])


def _decoded(
    view: memoryview,
    leaf: Nodes,
    at: Ints,
    bits: Ints,
    background: npt.NDArray[np.float32],
    active: Bits,
    signed: bool,
) -> npt.NDArray[np.float32]:
    """Decode leaves to (q, 512, 1): least + code * quantum.

    An inactive voxel within a quantum of the background gets the background's value.
    """
    octets, code = np.frombuffer(view, np.uint8), np.empty((len(leaf), 512), np.uint16)
    for width in np.unique(bits).tolist():
        own = np.flatnonzero(bits == width)
        code[own] = _codes(octets[at[own, None] + np.arange(64 * width)], width)
    with np.errstate(all="ignore"):  # damaged files: infinite and NaN values are reported later
        quantum = leaf["quantum"][:, None]
        dense = leaf["least"][:, None] + quantum * code.astype(np.float32)
        for known in (background, -background) if signed else (background,):
            np.copyto(dense, known, where=~active & (np.abs(dense - known) <= np.abs(quantum)))
    decoded: npt.NDArray[np.float32] = dense[..., None]
    return decoded


def _codes(octets: npt.NDArray[np.uint8], width: int) -> npt.NDArray[np.uint16]:
    """Unpack (q, 64 width) bytes to (q, 512) codes, lowest bits first."""
    if width >= 8:
        return octets.view(f"<u{width // 8}").astype(np.uint16)
    shifts = np.arange(0, 8, width, dtype=np.uint8)
    return ((octets[:, :, None] >> shifts) & ((1 << width) - 1)).reshape(len(octets), 512).astype(np.uint16)


def _floats(values: Nodes) -> npt.NDArray[np.float32]:
    return cast(values, np.float32)


MAGIC = int.from_bytes(b"NanoVDB0", "little")
# Since version 32.7 grids and files have magic numbers of their own.
GRID_MAGIC, FILE_MAGIC = (int.from_bytes(each, "little") for each in (b"NanoVDB1", b"NanoVDB2"))
LAST_LONG_CHECKSUM = 32 << 21 | 6 << 10  # version 32.6.0: the last whose first CRC includes the root
CODECS = {"none": 0, "zip": 1, "blosc": 2}
BLOSC_CHUNK = 1 << 30  # bytes of a grid in one blosc buffer
HALF_CHECKSUM = 0xFFFFFFFF  # value of the second CRC if the file has only the first
EMPTY_BOX = np.array([2**31 - 1] * 3 + [-(2**31)] * 3, np.int32)
CLASSES = {"unknown": 0, "level set": 1, "fog volume": 2, "staggered": 3}
INDEX_CLASS, CHANNEL_BLIND = 8, 4
MAJOR = 32
FLAG_LONG_NAME, FLAG_BOX, FLAG_STATS, FLAG_BREADTH_FIRST = 1, 2, 4 | 8 | 16, 32
KNOWN_FLAGS = FLAG_LONG_NAME | FLAG_BOX | FLAG_STATS | FLAG_BREADTH_FIRST
NAME_SIZE = 256  # with the NUL

Dtype = np.dtype[Any]


def _struct(itemsize: int, /, **fields: tuple[int, Any]) -> Dtype:
    """Return the dtype of a struct with this size in bytes; each field is (offset, format)."""
    offsets, formats = zip(*fields.values(), strict=True)
    return np.dtype({"names": list(fields), "formats": formats, "offsets": offsets, "itemsize": itemsize})


FILE = _struct(16, magic=(0, "<u8"), version=(8, "<u4"), grids=(12, "<u2"), codec=(14, "<u2"))
META = _struct(
    176,
    grid_size=(0, "<u8"), file_size=(8, "<u8"), name_key=(16, "<u8"), voxels=(24, "<u8"), type=(32, "<u4"),
    grid_class=(36, "<u4"), world=(40, "(6,)<f8"), box=(88, "(6,)<i4"), voxel=(112, "(3,)<f8"), name_size=(136, "<u4"),
    nodes=(140, "(4,)<u4"), tiles=(156, "(3,)<u4"), codec=(168, "<u2"), blind=(170, "<u2"), version=(172, "<u4"),
)  # fmt: skip
GRID = _struct(
    672,
    magic=(0, "<u8"), crc=(8, "(2,)<u4"), version=(16, "<u4"), flags=(20, "<u4"), index=(24, "<u4"), grids=(28, "<u4"),
    size=(32, "<u8"), name=(40, "S256"),
    mat_f=(296, "(3,3)<f4"), inv_f=(332, "(3,3)<f4"), vec_f=(368, "(3,)<f4"), taper_f=(380, "<f4"),
    mat=(384, "(3,3)<f8"), inv=(456, "(3,3)<f8"), vec=(528, "(3,)<f8"), taper=(552, "<f8"),
    world=(560, "(6,)<f8"), voxel=(608, "(3,)<f8"), grid_class=(632, "<u4"), type=(636, "<u4"),
    blind_offset=(640, "<i8"), blind=(648, "<u4"), values=(656, "<u8"),
)  # fmt: skip
TREE = _struct(64, offsets=(0, "(4,)<i8"), counts=(32, "(3,)<u4"), tiles=(44, "(3,)<u4"), voxels=(56, "<u8"))
BLIND = _struct(
    288,
    offset=(0, "<i8"), count=(8, "<u8"), value_size=(16, "<u4"), semantic=(20, "<u4"), blind_class=(24, "<u4"),
    type=(28, "<u4"), name=(32, "S256"),
)  # fmt: skip


class Layout(NamedTuple):
    """The structs of a grid type's nodes."""

    name: str
    number: int
    version: tuple[int, int, int]
    root: Dtype
    tile: Dtype
    upper: Dtype
    lower: Dtype
    leaf: Dtype
    value: str = "<f4"  # of backgrounds and tiles
    channels: int = 1

    @property
    def version_number(self) -> int:
        major, minor, patch = self.version
        return major << 21 | minor << 10 | patch


def _inner(bits: int, size: int, table: int, stats: Any) -> Dtype:
    """An inner node: box, flags, masks of active tiles and of children, statistics, and slots of 8 or 16 bytes.

    A slot contains a child offset or a value.
    """
    words, slots = (1 << bits) // 64, 1 << bits
    mask, slot = f"({words},)<u8", (size - table) // slots // 8
    fields = {
        "box": (0, "(6,)<i4"), "flags": (24, "<u8"), "tiles": (32, mask), "children": (32 + 8 * words, mask),
        "table": (table, f"({slots},{slot})<i8"),
    }  # fmt: skip
    return _struct(size, **fields, **({"stats": (32 + 16 * words, stats)} if stats else {}))


def _leaf(size: int, **fields: tuple[int, Any]) -> Dtype:
    return _struct(size, low=(0, "(3,)<i4"), dif=(12, "(3,)u1"), flags=(15, "u1"), mask=(16, "(8,)<u8"), **fields)


def _root(size: int, **fields: tuple[int, Any]) -> Dtype:
    return _struct(size, box=(0, "(6,)<i4"), tiles=(24, "<u4"), **fields)


def _tile(value: tuple[int, Any]) -> Dtype:
    return _struct(32, key=(0, "<u8"), child=(8, "<i8"), state=(16, "<u4"), value=value)


_FLOATS = (
    _root(64, background=(28, "(1,)<f4"), stats=(32, "(4,)<f4")),
    _tile((20, "(1,)<f4")),
    _inner(15, 270400, 8256, "(4,)<f4"),
    _inner(12, 33856, 1088, "(4,)<f4"),
)
FLOAT = Layout("Float", 1, (32, 4, 2), *_FLOATS, _leaf(2144, stats=(80, "(4,)<f4"), values=(96, "(512,1)<f4")))
DOUBLE = Layout(
    "Double", 2, (32, 4, 2),
    _root(96, background=(32, "(1,)<f8")), _tile((24, "(1,)<f8")),
    _inner(15, 270400, 8256, None), _inner(12, 33856, 1088, None), _leaf(4224, values=(128, "(512,1)<f8")),
    "<f8",
)  # fmt: skip
VEC3F = Layout(
    "Vec3f", 6, (32, 4, 2),
    _root(96, background=(28, "(3,)<f4")), _tile((20, "(3,)<f4")),
    _inner(15, 532544, 8256, None), _inner(12, 66624, 1088, None), _leaf(6272, values=(128, "(512,3)<f4")),
    channels=3,
)  # fmt: skip


def _quantised(name: str, number: int, size: int, **values: tuple[int, Any]) -> Layout:
    """A type with codes between the leaf's minimum and maximum: least + code * quantum."""
    head = {"least": (80, "<f4"), "quantum": (84, "<f4"), "stats": (88, "(4,)<u2")}
    return Layout(name, number, (32, 4, 2), *_FLOATS, _leaf(size, **head, **values))


FP4 = _quantised("Fp4", 13, 352, values=(96, "(256,)u1"))
FP8 = _quantised("Fp8", 14, 608, values=(96, "(512,)u1"))
FP16 = _quantised("Fp16", 15, 1120, values=(96, "(512,)<u2"))
FPN = _quantised("FpN", 16, 96)  # 512 codes of 1, 2, 4, 8 or 16 bits follow each leaf
BITS = {FP4.name: 4, FP8.name: 8, FP16.name: 16}
ON_INDEX = Layout(
    "OnIndex", 20, (32, 6, 0),
    _root(96, background=(32, "<u8")), _tile((24, "<u8")),
    _inner(15, 270400, 8256, None), _inner(12, 33856, 1088, None), _leaf(96, first=(80, "<u8"), prefix=(88, "<u8")),
)  # fmt: skip
LAYOUTS = {layout.number: layout for layout in (FLOAT, DOUBLE, VEC3F, FP4, FP8, FP16, FPN, ON_INDEX)}
# Names of the grid types that are not supported.
OTHERS = {
    3: "Int16", 4: "Int32", 5: "Int64", 7: "Vec3d", 8: "Mask", 9: "Half", 10: "UInt32", 11: "Boolean", 12: "RGBA8",
    17: "Vec4f", 18: "Vec4d", 19: "Index", 21: "IndexMask", 22: "OnIndexMask", 23: "PointIndex", 24: "Vec3u8",
    25: "Vec3u16", 26: "UInt8",
}  # fmt: skip
# Blind data: the type numbers of the dtypes that a table may have.
TABLE_TYPES = {"float32": 1, "float16": 9}
