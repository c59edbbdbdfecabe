"""The fields that all octree formats share: convert an octree to fields and back, and check them.

Fields 1 to 6 are defined in TR-24-01's listing 3 (docs/sources.md). Fields 7 and up are nerfbake's additions and may
be absent. schemas/README.md describes all of them:

    type_url, width, height, depth, node_children, node_data                     listing 3
    data_format, data_dim, level_sizes, origin, voxel_size, extra_data           additions

In the `report` profile node_children and node_data are plain lists of numbers; in `bulk` each is a Blob.
"""

from __future__ import annotations

import math
from array import array
from collections.abc import Mapping
from typing import Any, Literal, Protocol

import numpy as np
import numpy.typing as npt

from nerfbake import memory
from nerfbake.errors import InvalidFile, InvalidScene, Problem
from nerfbake.formats.wire.blob import Blob, Record, array_fields, blob_in
from nerfbake.kernels.maths.elementary import cast
from nerfbake.kernels.soundness import all_finite
from nerfbake.scene.basis import SH_SIZES, guess_data_format, parse_basis
from nerfbake.scene.octree import SparseVoxelOctree

Profile = Literal["report", "bulk"]
NoChild = Literal[0, -1]

MAX_2GIB = 2**31 - 1
SMALL_SIZE = 1 << 20  # bytes: upper bound of all small fields and of a format's overhead


def children_with(children: npt.NDArray[np.int32], no_child: int) -> npt.NDArray[np.int32]:
    """The children table with 0 (as in memory) or -1 for "no child"."""
    return children if no_child == 0 else np.where(children == 0, np.int32(no_child), children)


def small_fields(octree: SparseVoxelOctree, voxel_type: VoxelType = "number") -> dict[str, Any]:
    """All fields except the two large arrays, as Python types."""
    fields = {
        "type_url": type_url_of(octree, voxel_type),
        **dict(zip(("width", "height", "depth"), octree.size, strict=True)),
        "data_format": octree.data_format,
        "data_dim": octree.data_dim,
        "level_sizes": octree.level_sizes,
        "origin": octree.origin.tolist(),
        "voxel_size": octree.voxel_size.tolist(),
    }
    if octree.extra_data is not None:
        fields["extra_data"] = octree.extra_data.ravel().tolist()
    return fields


# The fields of FlatBuffers and Cap'n Proto in the schemas' order, with how they are read: text, an int32, or a list of
# this dtype. The large arrays are lists in the report profile; in bulk they are blobs, which are tables.
TABLE = {
    "type_url": "text", "width": "number", "height": "number", "depth": "number",
    "node_children": "<i4", "node_data": "<f4",
    "data_format": "text", "data_dim": "number", "level_sizes": "<i4",
    "origin": "<f8", "voxel_size": "<f8", "extra_data": "<f4",
    "node_children_blob": "table", "node_data_blob": "table",
}  # fmt: skip


class FieldTable(Record, Protocol):
    """A struct or table that also has numbers and nested tables."""

    def number(self, index: int, /) -> int: ...

    def table(self, index: int, /) -> Record | None: ...


def table_of(octree: SparseVoxelOctree, *, no_child: NoChild, profile: Profile, voxel_type: VoxelType) -> list[Any]:
    """Return the fields in the order of TABLE; None: absent."""
    small = small_fields(octree, voxel_type)
    children, data = children_with(octree.node_children, no_child), octree.node_data
    report = profile == "report"
    return [
        small["type_url"],
        *octree.size,
        children if report else None,
        data.astype(np.float32, copy=False) if report else None,
        octree.data_format or None,
        octree.data_dim,
        np.array(octree.level_sizes, np.int32),
        octree.origin,
        octree.voxel_size,
        octree.extra_data,
        None if report else array_fields(children),
        None if report else array_fields(data),
    ]


def octree_from_table(table: FieldTable, index: Mapping[str, int]) -> SparseVoxelOctree:
    """Read an octree of either profile; its arrays are views of the file. index: of each field of TABLE."""

    def read(name: str, kind: str) -> Any:
        blob = blob_in(table.table(index[f"{name}_blob"])) if name in _LARGE else None
        if blob is not None:
            return blob
        at = index[name]
        return table.text(at) if kind == "text" else table.number(at) if kind == "number" else table.array(at, kind)

    return octree_from_fields({name: read(name, kind) for name, kind in TABLE.items() if kind != "table"})


def require_finite(octree: SparseVoxelOctree, form: str, *, node_data: bool) -> None:
    """Raise InvalidScene before anything is written if a value is NaN or infinite. node_data: check node_data, too."""
    for name in ("node_data", "origin", "voxel_size", "extra_data"):
        values = getattr(octree, name)
        if values is not None and (node_data or name != "node_data") and not all_finite(values):
            allowed = f"finite numbers in {form}" + (", or the bulk profile" if name == "node_data" else "")
            raise InvalidScene(Problem(name, "holds NaN or infinity", allowed))


def require_size(form: str, size: int, limit: int, whose: str) -> None:
    """Raise InvalidScene before anything is written if the file would exceed the format's size limit."""
    if size > limit:
        raise InvalidScene(Problem(form, f"would take {size:,} bytes", f"{limit:,}, {whose}"))


def octree_from_fields(fields: Mapping[str, Any]) -> SparseVoxelOctree:
    """Build the octree from a file's fields. Fields that are not in listing 3 may be absent, empty or 0.

    node_children and node_data are a Blob, a list of numbers or a flat array; text is str, small arrays are lists or
    arrays. Raises InvalidFile for invalid fields. The topology is not checked here: the scene reports its problems.
    """
    type_url = _text(fields, "type_url")
    dtype = stored_dtype(type_url)
    children = _large(fields, "node_children", np.dtype("<i4"))
    if children.size % 8:
        raise InvalidFile(Problem("node_children", f"has {children.size:,} numbers", "a multiple of 8"))
    data = _large(fields, "node_data", dtype)
    level_sizes = _numbers(fields.get("level_sizes"), "level_sizes", np.dtype(np.int64))
    n = int(level_sizes.sum()) if level_sizes.size else children.size // 8
    if n < 1 or (level_sizes < 0).any() or (level_sizes > data.size).any():
        raise InvalidFile(Problem("level_sizes", f"adds up to {n:,} nodes", f"1 to {data.size:,}"))
    data_dim, rest = divmod(data.size, n)
    if rest or not data_dim or (data.ndim == 2 and len(data) != n):
        found = f"has {data.size:,} values ({data.nbytes:,} bytes) for {n:,} nodes"
        raise InvalidFile(Problem("node_data", found, f"a multiple of {n:,}, not 0"))
    if (declared := _whole(fields, "data_dim")) not in (0, data_dim):
        raise InvalidFile(Problem("data_dim", f"is {declared}", f"{data_dim}, as many values as a node has"))
    data_format = named_format(type_url, _text(fields, "data_format"))
    octree = assemble(
        size=(_whole(fields, "width"), _whole(fields, "height"), _whole(fields, "depth")),
        children=children.reshape(-1, 8),
        data=data.reshape(n, data_dim),
        data_format=data_format,
        origin=_three(fields, "origin", 0.0),
        voxel_size=_three(fields, "voxel_size", 1.0),
        extra_data=_lobes(fields, data_format),
    )
    if level_sizes.size and not octree.structure_problems() and octree.level_sizes != level_sizes.tolist():
        found = f"are {level_sizes.tolist()[:14]}"
        raise InvalidFile(Problem("level_sizes", found, f"{octree.level_sizes} as node_children says"))
    return octree


def assemble(
    *,
    size: tuple[int, int, int],
    children: npt.NDArray[Any],
    data: npt.NDArray[Any],
    data_format: str,
    origin: npt.NDArray[Any],
    voxel_size: npt.NDArray[Any],
    extra_data: npt.NDArray[np.float32] | None,
) -> SparseVoxelOctree:
    """Build an octree from a file's arrays.

    A child of -1 is read as 0, nodes in another order are sorted breadth-first, and an empty data format is guessed
    from the number of values. children: (c, 8) integers. Invalid values stay as they are: the scene reports them.
    """
    if children.dtype != np.int32:
        if children.size and (abs(int(children.max())) > 2**31 - 1 or abs(int(children.min())) > 2**31 - 1):
            raise InvalidFile(Problem("node_children", "holds numbers beyond 32 bits", "-1 to 2147483647"))
        memory.hold("node_children", 4 * children.size)
        children = children.astype(np.int32)
    memory.require("node_children", children.size)
    if children.size and (children == -1).any():
        memory.hold("node_children", children.nbytes)
        children = np.where(children == -1, np.int32(0), children)
    data_format = data_format or guess_data_format(data.shape[1])
    octree = SparseVoxelOctree(size, children, data, data_format, origin, voxel_size, extra_data)
    return octree.breadth_first()


def _large(fields: Mapping[str, Any], name: str, dtype: np.dtype[Any]) -> npt.NDArray[Any]:
    value = fields.get(name)
    if not isinstance(value, Blob):
        return _numbers(value, name, dtype)
    if value.dtype != dtype.str:
        raise InvalidFile(Problem(name, f"has dtype {value.dtype[:40]!r}", f"{dtype.str!r}"))
    size = dtype.itemsize * math.prod(value.shape)
    fits = len(value.shape) == 2 and min(value.shape) >= 0 and size == len(value.data)
    if not fits or (name == "node_children" and value.shape[1] != 8):
        found = f"declares shape {value.shape} {value.dtype} over {len(value.data):,} bytes"
        raise InvalidFile(Problem(name, found, "two dimensions that fill the bytes, 8 columns for node_children"))
    return np.frombuffer(value.data, dtype).reshape(value.shape)


def _numbers(value: Any, name: str, dtype: np.dtype[Any]) -> npt.NDArray[Any]:
    """Convert a list or array of numbers to a flat array of this dtype.

    Raises InvalidFile instead of rounding to whole numbers or turning a finite value into infinity.
    """
    if value is None:
        return np.empty(0, dtype)
    if isinstance(value, np.ndarray):
        flat = value.reshape(-1)
    elif isinstance(value, list):
        try:  # array() accepts only numbers: no text, no None, no lists. It takes true as 1, and false as 0
            if name not in _LARGE and bool in map(type, value):
                raise TypeError
            memory.hold(name, 9 * len(value))  # 8 bytes a number; the array over-allocates by an eighth
            flat = np.frombuffer(array("q" if dtype.kind == "i" else "d", value), f"{dtype.kind}8")
        except (TypeError, ValueError, OverflowError):
            raise InvalidFile(
                Problem(name, "holds a value that is not a number", f"a flat list of {_KINDS[dtype.kind]}")
            ) from None
    else:
        raise InvalidFile(Problem(name, f"is {type(value).__name__}", f"a flat list of {_KINDS[dtype.kind]}"))
    if flat.dtype.itemsize <= dtype.itemsize:
        if flat.dtype.itemsize < dtype.itemsize:
            memory.hold(name, flat.size * dtype.itemsize)
        return flat.astype(dtype, copy=False)
    memory.hold(name, flat.size * (dtype.itemsize + 1))
    memory.require(name, flat.size)
    narrow = cast(flat, dtype)
    lost = narrow != flat if dtype.kind == "i" else np.isinf(narrow) & np.isfinite(flat)
    if lost.any():
        raise InvalidFile(Problem(name, f"holds {flat[lost.argmax()].item()}", f"numbers that {dtype.name} can hold"))
    return narrow


_LARGE = ("node_children", "node_data")  # not searched for true and false: that takes as long as converting them
_KINDS = {"i": "whole numbers", "f": "numbers"}


def _text(fields: Mapping[str, Any], name: str) -> str:
    value = fields.get(name, "")
    if not isinstance(value, str):
        raise InvalidFile(Problem(name, f"is {type(value).__name__}", "text"))
    return value


def _whole(fields: Mapping[str, Any], name: str) -> int:
    value = fields.get(name, 0)
    if type(value) is not int or abs(value) > MAX_2GIB:
        raise InvalidFile(Problem(name, f"is {str(value)[:40]}", "a whole number of 32 bits"))
    return value


def _three(fields: Mapping[str, Any], name: str, default: float) -> npt.NDArray[np.float64]:
    values = _numbers(fields.get(name), name, np.dtype(np.float64))
    if values.size not in (0, 3):
        raise InvalidFile(Problem(name, f"has {values.size:,} numbers", "3"))
    return values if values.size else np.full(3, default)


def _lobes(fields: Mapping[str, Any], data_format: str) -> npt.NDArray[np.float32] | None:
    values = _numbers(fields.get("extra_data"), "extra_data", np.dtype(np.float32))
    if not values.size:
        return None
    size = parse_basis(data_format).size
    if values.size % size:
        raise InvalidFile(Problem("extra_data", f"has {values.size:,} numbers", f"a multiple of {size}"))
    return values.reshape(size, -1)


VoxelType = Literal["number", "struct"]


_HOME = "type.googleapis.com/"


TYPE_URLS = {"float32": f"{_HOME}google.protobuf.FloatValue", "float16": f"{_HOME}svo.protobuf.Float16Value"}


NAMED = ("RGBA", *(f"SH{size}" for size in SH_SIZES))  # data formats whose voxels have a message


_VOXELS = {
    f"{_HOME}svo.protobuf.{data_format}{half}Voxel": (dtype, data_format)
    for data_format in NAMED
    for half, dtype in (("", "<f4"), ("Half", "<f2"))
}


_MEANINGS = {TYPE_URLS["float32"]: ("<f4", ""), TYPE_URLS["float16"]: ("<f2", ""), **_VOXELS}


def type_url_of(octree: SparseVoxelOctree, voxel_type: VoxelType) -> str:
    """Return the type URL of a value (`number`), or of a node with all its values named (`struct`).

    Raises InvalidScene if no such type exists.
    """
    dtype = octree.node_rows.dtype
    if voxel_type == "number":
        return TYPE_URLS[dtype.name]
    if octree.data_format not in NAMED:
        found = f"is {octree.data_format!r}, which has no voxel type"
        raise InvalidScene(Problem("data_format", found, f"{', '.join(NAMED)}, or the voxel type 'number'"))
    return next(url for url, known in _VOXELS.items() if known == (dtype.newbyteorder("<").str, octree.data_format))


def stored_dtype(type_url: str) -> np.dtype[Any]:
    """The number type of node_data; float32 for an empty type_url. Raises InvalidFile for an unknown type."""
    return np.dtype(_meaning(type_url)[0])


def named_format(type_url: str, data_format: str) -> str:
    """Return the data format from data_format, or from the voxel type in type_url.

    Raises InvalidFile if the two differ.
    """
    named = _meaning(type_url)[1]
    if named and data_format and named != data_format:
        raise InvalidFile(
            Problem("type_url", f"names a voxel of {named}", f"one of {data_format[:40]}, as data_format says")
        )
    return named or data_format


def _meaning(type_url: str) -> tuple[str, str]:
    found = _MEANINGS.get(type_url or TYPE_URLS["float32"])
    if found is None:
        allowed = f"{' or '.join(TYPE_URLS.values())}, or a voxel of schemas/voxels.proto"
        raise InvalidFile(Problem("type_url", f"is {type_url[:80]!r}", allowed))
    return found
