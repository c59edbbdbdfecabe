"""What a file calls the type of its values, and of its voxels."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from nerfbake.errors import InvalidFile, InvalidScene
from nerfbake.formats.octree.fields import NAMED, TYPE_URLS, stored_dtype, type_url_of
from nerfbake.scene.basis import parse_basis, voxel_dtype
from nerfbake.scene.octree import SparseVoxelOctree
from tests.support.octrees import FORMATS, read, small_octree
from tests.support.scenes import assert_same_octree
from tests.support.tools import SCHEMAS

TYPED = [(name, profile) for name, form in FORMATS.items() for profile in form.choices("profile")]
HOME = "type.googleapis.com/svo.protobuf."


def typed(name: str, octree: SparseVoxelOctree, **options: Any) -> bytes:
    return b"".join(FORMATS[name].load_module().encode(octree, voxel_type="struct", **options))


@pytest.mark.parametrize(("name", "profile"), TYPED)
@pytest.mark.parametrize(("dtype", "half"), [(np.float32, b""), (np.float16, b"Half")])
def test_a_typed_file_differs_in_its_type_alone(name: str, profile: str, dtype: type, half: bytes) -> None:
    octree = small_octree(dtype)
    data = typed(name, octree, profile=profile)
    assert HOME.encode() + b"SH4" + half + b"Voxel" in data
    assert_same_octree(read(name, data), octree)


def test_every_format_that_states_a_type_can_state_a_voxels() -> None:
    assert {name for name, form in FORMATS.items() if form.choices("voxel_type")} == FORMATS.keys() - {"svo.npz"}


def test_a_type_stands_for_the_data_format_that_a_file_leaves_out() -> None:
    octree = small_octree()
    rgba = SparseVoxelOctree((1, 1, 1), np.zeros((1, 8), np.int32), np.ones((1, 4), np.float32), "SH1")
    data = typed("svo.pb", rgba)
    assert read("svo.pb", data.replace(b"\x3a\x03SH1", b"")).data_format == "SH1"  # four values would be RGBA's
    with pytest.raises(InvalidFile, match="type_url names a voxel of SH1; allowed: one of RGB, as data_format says"):
        read("svo.pb", data.replace(b"\x3a\x03SH1", b"\x3a\x03RGB"))
    with pytest.raises(InvalidScene, match="node_data has 13 values per node; allowed: 4 for data_format SH1"):
        read("svo.pb", typed("svo.pb", octree).replace(b"SH4Voxel", b"SH1Voxel").replace(b"\x3a\x03SH4", b""))


def test_what_has_no_type_is_not_written() -> None:
    octree = replace(small_octree(), data_format="SG4", extra_data=np.zeros((4, 4), np.float32))
    for name in ("svo.pb", "svo.json"):
        with pytest.raises(InvalidScene, match="data_format is 'SG4', which has no voxel type; allowed: RGB"):
            typed(name, octree)


def test_an_unknown_type_is_refused() -> None:
    for wrong in ("SH10Voxel", "SH9voxel", "svo.protobuf.SH9Voxel", HOME):
        with pytest.raises(
            InvalidFile, match=r"type_url is .*; allowed: type.* or .*, or a voxel of schemas/voxels\.proto"
        ):
            stored_dtype(wrong)
    assert stored_dtype("") == stored_dtype(TYPE_URLS["float32"]) == np.float32


@pytest.fixture(scope="module")
def messages(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Any]:
    """The descriptors that protoc makes of schemas/voxels.proto, by name."""
    from google.protobuf import descriptor_pb2, descriptor_pool
    from grpc_tools import protoc

    target = tmp_path_factory.mktemp("voxels") / "voxels.bin"
    assert protoc.main(["protoc", f"-I{SCHEMAS}", f"--descriptor_set_out={target}", "voxels.proto"]) == 0
    pool = descriptor_pool.DescriptorPool()
    for file in descriptor_pb2.FileDescriptorSet.FromString(Path(target).read_bytes()).file:
        pool.Add(file)
    return lambda name: pool.FindMessageTypeByName(f"svo.protobuf.{name}")


def names_of(message: Any) -> list[str]:
    """All numbers in a message, in order, by the way that leads to each."""
    names = []
    for field in message.fields:
        inner = names_of(field.message_type) if field.message_type else []
        names += [f"{field.name}.{name}" for name in inner] or [field.name]
    return names


@pytest.mark.parametrize("data_format", NAMED)
def test_the_schema_names_what_the_array_names(messages: Callable[[str], Any], data_format: str) -> None:
    dtype = voxel_dtype(parse_basis(data_format), np.dtype(np.float32))
    expected = [
        f"{colour}.{name}" if inner.names else colour
        for colour in dtype.names or ()
        for inner in [dtype[colour]]
        for name in inner.names or ("",)
    ]
    assert names_of(messages(f"{data_format}Voxel")) == expected
    assert messages(f"{data_format}HalfVoxel").fields[0].message_type == messages(f"{data_format}Voxel")
    values = np.ones((1, parse_basis(data_format).data_dim), np.float32)
    octree = SparseVoxelOctree((1, 1, 1), np.zeros((1, 8), np.int32), values, data_format)
    assert type_url_of(octree, "struct") == f"{HOME}{data_format}Voxel"
