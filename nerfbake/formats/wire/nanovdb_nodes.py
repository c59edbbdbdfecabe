"""The structs of a NanoVDB file, 32.4 and 32.6, as NumPy dtypes. Source: docs/formats/vdb.md, "NanoVDB files"."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

MAGIC = int.from_bytes(b"NanoVDB0", "little")
CODECS = {"none": 0, "zip": 1, "blosc": 2}
BLOSC_CHUNK = 1 << 30  # bytes of a grid in one blosc buffer
HALF_CHECKSUM = 0xFFFFFFFF  # in place of the second CRC: only the first is kept
EMPTY_BOX = np.array([2**31 - 1] * 3 + [-(2**31)] * 3, np.int32)
CLASSES = {"unknown": 0, "level set": 1, "fog volume": 2, "staggered": 3}
INDEX_CLASS, CHANNEL_BLIND = 8, 4
FLAG_LONG_NAME, FLAG_BOX, FLAG_STATS, FLAG_BREADTH_FIRST = 1, 2, 4 | 8 | 16, 32
NAME_SIZE = 256  # with the NUL

Dtype = np.dtype[Any]


def _struct(itemsize: int, /, **fields: tuple[int, Any]) -> Dtype:
    """A struct of this many bytes; each field is (offset, format)."""
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
    """What a grid type's nodes look like."""

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
    """Box, flags, masks of active tiles and of children, statistics, slots of 8 or 16 bytes: child offset or value."""
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
    """Codes between each leaf's least and greatest value: least + code * quantum."""
    head = {"least": (80, "<f4"), "quantum": (84, "<f4"), "stats": (88, "(4,)<u2")}
    return Layout(name, number, (32, 4, 2), *_FLOATS, _leaf(size, **head, **values))


FP4 = _quantised("Fp4", 13, 352, values=(96, "(256,)u1"))
FP8 = _quantised("Fp8", 14, 608, values=(96, "(512,)u1"))
FP16 = _quantised("Fp16", 15, 1120, values=(96, "(512,)<u2"))
FPN = _quantised("FpN", 16, 96)  # behind each leaf stand 512 codes of 1, 2, 4, 8 or 16 bits
BITS = {FP4.name: 4, FP8.name: 8, FP16.name: 16}
ON_INDEX = Layout(
    "OnIndex", 20, (32, 6, 0),
    _root(96, background=(32, "<u8")), _tile((24, "<u8")),
    _inner(15, 270400, 8256, None), _inner(12, 33856, 1088, None), _leaf(96, first=(80, "<u8"), prefix=(88, "<u8")),
)  # fmt: skip
LAYOUTS = {layout.number: layout for layout in (FLOAT, DOUBLE, VEC3F, FP4, FP8, FP16, FPN, ON_INDEX)}
# What grids of other types are called.
OTHERS = {
    3: "Int16", 4: "Int32", 5: "Int64", 7: "Vec3d", 8: "Mask", 9: "Half", 10: "UInt32", 11: "Boolean", 12: "RGBA8",
    17: "Vec4f", 18: "Vec4d", 19: "Index", 21: "IndexMask", 22: "PointIndex", 23: "Vec3u8", 24: "Vec3u16",
}  # fmt: skip
# Of blind data: number and size of the types a table may have.
TABLE_TYPES = {"float32": 1, "float16": 9}
