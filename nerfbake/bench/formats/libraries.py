"""Write and read octrees with each format's Python library in the most obvious way, for comparison.

Each library writes the same two arrays with the names of TR-24-01 (docs/sources.md). It is imported when its row runs.
"""

from __future__ import annotations

import json
import tempfile
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake.scene.octree import SparseVoxelOctree

Arrays = tuple[npt.NDArray[Any], npt.NDArray[Any]]  # node_children, node_data; any shape

CAPNP_SCHEMA = """@0xd0f4b0a3c2e19587;
struct Octree { children @0 :List(Int32); data @1 :List(Float32); childrenBlob @2 :Data; dataBlob @3 :Data; }
"""


class Library(NamedTuple):
    """A way to write the octree with a library. slow: minutes for a large scene, so it is measured once."""

    name: str
    encode: Callable[[SparseVoxelOctree], Any]
    decode: Callable[[memoryview, SparseVoxelOctree], Arrays]
    slow: bool = False


def _lists(octree: SparseVoxelOctree) -> dict[str, Any]:
    return {"children": octree.node_children.ravel().tolist(), "data": octree.node_data.ravel().tolist()}


def _from_lists(document: Any, octree: SparseVoxelOctree) -> Arrays:
    return np.array(document["children"], np.int32), np.array(document["data"], octree.node_data.dtype)


def _json_encode(octree: SparseVoxelOctree) -> bytes:
    return json.dumps(_lists(octree)).encode()


def _json_decode(view: memoryview, octree: SparseVoxelOctree) -> Arrays:
    return _from_lists(json.loads(bytes(view)), octree)


def _bson_encode(octree: SparseVoxelOctree) -> bytes:
    import bson

    return bson.encode(_lists(octree))


def _bson_decode(view: memoryview, octree: SparseVoxelOctree) -> Arrays:
    import bson

    return _from_lists(bson.decode(view), octree)


def _bson_blob_encode(octree: SparseVoxelOctree) -> bytes:
    import bson

    return bson.encode({"children": octree.node_children.tobytes(), "data": octree.node_data.tobytes()})


def _bson_blob_decode(view: memoryview, octree: SparseVoxelOctree) -> Arrays:
    import bson

    return _from_blobs(**bson.decode(view), octree=octree)


def _from_blobs(children: Any, data: Any, octree: SparseVoxelOctree) -> Arrays:
    return np.frombuffer(children, "<i4"), np.frombuffer(data, octree.node_data.dtype)


def _protobuf_class() -> Any:
    """Return a message class with the two arrays of listing 3, without generated code."""
    from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

    file = descriptor_pb2.FileDescriptorProto(name="octree.proto", package="bench", syntax="proto3")
    fields = file.message_type.add(name="Octree").field
    fields.add(name="node_children", number=5, label=3, type=5).options.packed = True
    fields.add(name="node_data", number=6, label=1, type=12)
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName("bench.Octree"))


def _protobuf_encode(octree: SparseVoxelOctree) -> bytes:
    message = _protobuf_class()(node_data=octree.node_data.tobytes())
    message.node_children.extend(octree.node_children.ravel().tolist())
    return bytes(message.SerializeToString())


def _protobuf_decode(view: memoryview, octree: SparseVoxelOctree) -> Arrays:
    message = _protobuf_class().FromString(bytes(view))
    return _from_blobs(np.array(message.node_children, np.int32), message.node_data, octree)


def _flatbuffers_encode(octree: SparseVoxelOctree) -> Any:
    import flatbuffers

    builder = flatbuffers.Builder(octree.node_children.nbytes + octree.node_data.nbytes + 1024)
    offsets = [builder.CreateNumpyVector(values.ravel()) for values in (octree.node_children, _single(octree))]
    return _flatbuffers_finish(builder, offsets)


def _flatbuffers_naive_encode(octree: SparseVoxelOctree) -> Any:
    import flatbuffers

    builder, offsets = flatbuffers.Builder(), []
    children, data = octree.node_children.ravel().tolist(), octree.node_data.ravel().tolist()
    for values, prepend in ((children, builder.PrependInt32), (data, builder.PrependFloat32)):
        builder.StartVector(4, len(values), 4)
        for value in reversed(values):
            prepend(value)
        offsets.append(builder.EndVector())
    return _flatbuffers_finish(builder, offsets)


def _flatbuffers_finish(builder: Any, offsets: list[int]) -> Any:
    builder.StartObject(2)
    for slot, offset in enumerate(offsets):
        builder.PrependUOffsetTRelativeSlot(slot, offset, 0)
    builder.Finish(builder.EndObject())
    return memoryview(builder.Bytes)[builder.Head() :]


def _flatbuffers_decode(view: memoryview, octree: SparseVoxelOctree) -> Arrays:
    from flatbuffers import encode, number_types, table

    root = table.Table(view, encode.Get(number_types.UOffsetTFlags.packer_type, view, 0))
    flags = (number_types.Int32Flags, number_types.Float32Flags)
    children, data = (root.GetVectorAsNumpy(kind, root.Offset(4 + 2 * slot)) for slot, kind in enumerate(flags))
    return children, data.astype(octree.node_data.dtype, copy=False)


def _single(octree: SparseVoxelOctree) -> npt.NDArray[np.float32]:
    return octree.node_data.astype(np.float32, copy=False)


@cache  # pycapnp aborts the process if it loads a schema again from another path
def _capnp_class() -> Any:
    import capnp

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "octree.capnp"
        path.write_text(CAPNP_SCHEMA)
        return capnp.load(str(path)).Octree


def _capnp_encode(octree: SparseVoxelOctree) -> bytes:
    return bytes(_capnp_class().new_message(**_lists(octree)).to_bytes())


def _capnp_decode(view: memoryview, octree: SparseVoxelOctree) -> Arrays:
    with _capnp_class().from_bytes(view, traversal_limit_in_words=len(view) // 8 + 64) as message:
        return np.array(list(message.children), np.int32), np.array(list(message.data), octree.node_data.dtype)


def _capnp_blob_encode(octree: SparseVoxelOctree) -> bytes:
    children, data = octree.node_children.tobytes(), octree.node_data.tobytes()
    return bytes(_capnp_class().new_message(childrenBlob=children, dataBlob=data).to_bytes())


def _capnp_blob_decode(view: memoryview, octree: SparseVoxelOctree) -> Arrays:
    with _capnp_class().from_bytes(view, traversal_limit_in_words=len(view) // 8 + 64) as message:
        return _from_blobs(bytes(message.childrenBlob), bytes(message.dataBlob), octree)


LIBRARIES = (
    Library("json.dumps", _json_encode, _json_decode, slow=True),
    Library("pymongo bson, lists", _bson_encode, _bson_decode),
    Library("pymongo bson, bytes", _bson_blob_encode, _bson_blob_decode),
    Library("protobuf, extend(list)", _protobuf_encode, _protobuf_decode),
    Library("flatbuffers, by element", _flatbuffers_naive_encode, _flatbuffers_decode, slow=True),
    Library("flatbuffers, NumPy vector", _flatbuffers_encode, _flatbuffers_decode),
    Library("pycapnp, lists", _capnp_encode, _capnp_decode),
    Library("pycapnp, Data", _capnp_blob_encode, _capnp_blob_decode),
)
