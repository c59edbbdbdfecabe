"""Crates, text and packages: OpenUSD reads the same from all of them."""

from __future__ import annotations

import io
import struct
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from pxr import Sdf, Usd

from nerfbake.errors import InvalidScene
from nerfbake.formats.wire.usd.crate import encode_crate
from nerfbake.formats.wire.usd.package import encode_package
from nerfbake.formats.wire.usd.stage import KINDS, Attribute, Prim, Relationship, UsdStage, prim_names
from nerfbake.formats.wire.usd.text import encode_text
from tests.support.usd import exported, facts_of, opened

RANDOM = np.random.default_rng(3)


def value_of(kind: str) -> Any:
    base, array = kind.removesuffix("[]"), kind.endswith("[]")
    _, dtype, columns = KINDS[base]
    if not dtype:
        text = {"string": 'a "quoted"\\ line\n', "asset": "./a@b c.png", "token": "word"}[base]
        return [text, "./other"] if array else text
    shape = (21, columns) if array else (columns,)
    numbers = RANDOM.integers(0, 2, shape) if base == "bool" else RANDOM.normal(scale=100, size=shape)
    return numbers if array or columns > 1 else numbers[0]


def everything() -> UsdStage:
    """A stage with a value of every kind that is written, connections, relationships, schemas and nested prims."""
    kinds = [
        kind + array
        for kind in KINDS
        for array in ("", "[]")
        if kind + array not in ("bool[]", "matrix4d[]", "asset[]")
    ]
    values = {f"a{i}": Attribute(kind, value_of(kind), custom=True) for i, kind in enumerate(kinds)}
    values["none"] = Attribute("int[]", np.zeros(0), {"interpolation": "vertex", "elementSize": 3}, uniform=True)
    values["small"] = Attribute("int[]", [1, 2], uniform=True)
    inner = Prim("inner", "Shader", {"outputs:rgb": Attribute("float3")})
    last: dict[str, Attribute | Relationship] = {
        "one": Relationship(("/root/Größe",)),
        "two": Relationship(("/root/Größe", "/root/Größe/inner")),
        "linked": Attribute("float3", source="/root/Größe/inner.outputs:rgb"),
    }
    children = (Prim("Größe", "Mesh", values, (inner,)), Prim("last", "Material", last, schemas=("A", "B")))
    return UsdStage(Prim("root", "Xform", children=children), "Z")


def test_a_crate_and_text_hold_the_same(tmp_path: Path) -> None:
    stage = everything()
    text = exported(tmp_path / "a.usda", b"".join(encode_text(stage)))
    assert exported(tmp_path / "a.usdc", b"".join(encode_crate(stage))) == text
    assert text.count(" = ") > 2 * len(KINDS)
    assert facts_of(Usd.Stage.Open(str(tmp_path / "a.usdc"))) == ("Z", 1.0, "/root")


def test_every_value_comes_back_bit_for_bit(tmp_path: Path) -> None:
    stage = everything()
    found = opened(tmp_path / "a.usdc", b"".join(encode_crate(stage)))
    for name, attribute in stage.root.children[0].properties.items():
        assert isinstance(attribute, Attribute)
        base = attribute.kind.removesuffix("[]")
        value = found.GetPrimAtPath("/root/Größe").GetAttribute(name).Get()
        if KINDS[base].dtype and attribute.kind.endswith("[]"):
            numbers = np.asarray(attribute.value, KINDS[base].dtype).reshape(-1, KINDS[base].columns)
            if base.startswith("quat"):
                numbers = numbers[:, [1, 2, 3, 0]]  # USD has w last in memory
            assert np.asarray(value).tobytes() == numbers.tobytes(), attribute.kind
        elif base == "quatf":
            assert [value.GetReal(), *value.GetImaginary()] == np.asarray(attribute.value, np.float32).tolist()


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("usd") / "a.usdc"


@settings(max_examples=40)
@given(numbers=st.lists(st.integers(-(2**31), 2**31 - 1), min_size=16, max_size=60))
@example(numbers=[0] * 16)
@example(numbers=[2**31 - 1, -(2**31)] * 9)
@example(numbers=[127, -1, -129, 32767, -1, -32769, 5, 5, 5] * 2)
def test_packed_whole_numbers_are_read_as_they_were(place: Path, numbers: list[int]) -> None:
    root = Prim("a", "", {"x": Attribute("int[]", np.array(numbers), custom=True)})
    place.write_bytes(b"".join(encode_crate(UsdStage(root, "Y"))))
    layer = Sdf.Layer.OpenAsAnonymous(str(place))
    assert list(layer.GetAttributeAtPath("/a.x").default) == numbers


def test_packed_triangles_take_a_third_of_plain_ones() -> None:
    corners = np.add.outer(np.arange(3000), [0, 1, 2]).reshape(-1)
    root = Prim("a", "Mesh", {"faceVertexIndices": Attribute("int[]", corners)})
    assert len(b"".join(encode_crate(UsdStage(root, "Y")))) < 4 * len(corners) / 3


def test_names_are_unique_identifiers_of_any_script() -> None:
    wanted = ["Größe", "a b", "a_b", "1st", "スプラット", "", "a/b", "..", "é", "e\u0301", "a" * 500]
    names = list(prim_names(wanted, default="camera"))
    assert names[:8] == ["Größe", "a_b", "a_b_1", "_1st", "スプラット", "camera", "a_b_2", "camera_1"]
    assert len({*names}) == len(names)
    assert all(Sdf.Path.IsValidIdentifier(name) for name in names)


# -- packages --------------------------------------------------------------------------------------------------
def archive(*names: str, size: int = 100) -> bytes:
    return b"".join(encode_package([(name, [b"x" * size, memoryview(b"yz")]) for name in names]))


def test_files_of_a_package_are_stored_at_multiples_of_64_with_the_first_date() -> None:
    data = archive("scene.usdc", "texture.png", "a/b/Größe.jpg")
    with zipfile.ZipFile(io.BytesIO(data)) as found:
        assert found.testzip() is None
        assert [info.filename for info in found.infolist()] == ["scene.usdc", "texture.png", "a/b/Größe.jpg"]
        for info in found.infolist():
            assert (info.compress_type, info.date_time[:3]) == (zipfile.ZIP_STORED, (1980, 1, 1))
            name_size, extra_size = struct.unpack_from("<HH", data, info.header_offset + 26)
            start = info.header_offset + 30 + name_size + extra_size
            assert start % 64 == 0
            assert data[start : start + 102] == b"x" * 100 + b"yz"
    assert archive("scene.usdc", "texture.png", "a/b/Größe.jpg") == data


@given(length=st.integers(1, 200))
def test_the_padding_of_a_package_fits_names_of_every_length(length: int) -> None:
    data = archive("n" * length + ".usdc")
    with zipfile.ZipFile(io.BytesIO(data)) as found:
        assert data.index(b"x" * 100) % 64 == 0
        assert found.read(found.namelist()[0]) == b"x" * 100 + b"yz"


@pytest.mark.parametrize("name", ["smoke.vdb", "a.PNG", "a.webp", "a.avif", "a.hdr", "a.txt", "a"])
def test_a_package_takes_no_other_types_of_files(name: str) -> None:
    with pytest.raises(InvalidScene, match=r"cannot be in a .usdz; allowed: .usda, .usdc, .usd, .png, .jpg, .jpeg"):
        archive("scene.usdc", name)


def test_openusd_opens_a_package_with_the_bytes_of_its_layer(tmp_path: Path) -> None:
    crate = list(encode_crate(everything()))
    stage = opened(tmp_path / "a.usdz", b"".join(encode_package([("scene.usdc", crate)])))
    text = exported(tmp_path / "a.usdc", b"".join(crate))
    assert stage.GetRootLayer().ExportToString() == text
