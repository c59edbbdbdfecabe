"""MessagePack: what the library `msgpack` writes, flax's arrays in it, and what a hostile author writes."""

from __future__ import annotations

import gzip
import struct
from contextlib import suppress
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from numpy.testing import assert_array_equal

from nerfbake.errors import InvalidFile, MemoryLimit
from nerfbake.formats.wire.msgpack import MAX_DEPTH, parse_map
from nerfbake.memory import memory_limit, scope


def packed(value: Any) -> bytes:
    return bytes(msgpack.packb(value))


def read(data: bytes, **options: Any) -> dict[str, Any]:
    return parse_map(memoryview(data), "it", **options)


def refused(data: bytes) -> str:
    with pytest.raises(InvalidFile) as caught:
        read(data)
    return str(caught.value)


def flax(shape: Any, dtype: Any, data: Any, kind: int = 1) -> msgpack.ExtType:
    return msgpack.ExtType(kind, packed([shape, dtype, data]))


def flax_array(array: npt.NDArray[Any]) -> msgpack.ExtType:
    return flax(array.shape, array.dtype.name, array.tobytes())


def flax_chunks(array: npt.NDArray[Any], size: int) -> dict[str, Any]:
    """What flax writes for an array of more than 2^30 bytes."""
    flat = array.reshape(-1)
    return {
        "__msgpack_chunked_array__": True,
        "shape": {str(i): edge for i, edge in enumerate(array.shape)},
        "chunks": {str(i): flax_array(flat[i * size : (i + 1) * size]) for i in range(-(-flat.size // size))},
    }


# -- values ----------------------------------------------------------------------------------------------------
# One value of each code, in hexadecimal.
VALUES_BY_HAND = [
    ("00", 0),
    ("7f", 127),
    ("e0", -32),
    ("ff", -1),
    ("c0", None),
    ("c2", False),
    ("c3", True),
    ("cc ff", 255),
    ("cd 0100", 256),
    ("ce 00010000", 65_536),
    ("cf ffffffffffffffff", 2**64 - 1),
    ("d0 80", -128),
    ("d1 8000", -32_768),
    ("d2 80000000", -(2**31)),
    ("d3 8000000000000000", -(2**63)),
    ("ca 3fc00000", 1.5),
    ("cb bff8000000000000", -1.5),
    ("a0", ""),
    ("a2 c3a9", "é"),
    ("d9 01 61", "a"),
    ("da 0001 61", "a"),
    ("db 00000001 61", "a"),
    ("c4 01 07", b"\7"),
    ("c5 0001 07", b"\7"),
    ("c6 00000001 07", b"\7"),
    ("92 01 02", [1, 2]),
    ("dc 0001 05", [5]),
    ("dd 00000001 05", [5]),
    ("81 a1 62 05", {"b": 5}),
    ("de 0001 a1 62 05", {"b": 5}),
    ("df 00000001 a1 62 05", {"b": 5}),
]


@pytest.mark.parametrize(("code", "value"), VALUES_BY_HAND)
def test_every_code_by_hand(code: str, value: Any) -> None:
    found = read(bytes.fromhex(f"81 a1 61 {code}"))["a"]
    assert found == value
    assert type(found) is (memoryview if isinstance(value, bytes) else type(value))


def test_bytes_are_slices_of_the_file() -> None:
    data = packed({"a": b"1234"})
    found = read(data)["a"]
    assert isinstance(found, memoryview)
    assert found.obj is data


TEXT = st.text(max_size=8)
VALUES: Any = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(2**63), 2**64 - 1)
    | st.floats(allow_nan=False)
    | TEXT
    | st.binary(max_size=40),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(TEXT, inner, max_size=4),
    max_leaves=8,
)


@given(st.dictionaries(TEXT, VALUES, max_size=4))
@example({str(i): {"x" * i: [i] * i, "b": b"x" * i} for i in (15, 16, 31, 32, 255, 256)})
@example({"text": "x" * 70_000, "bytes": b"x" * 70_000, "list": [0] * 70_000})
def test_what_the_library_writes_is_read(value: dict[str, Any]) -> None:
    assert read(packed(value)) == value


@given(st.dictionaries(TEXT, VALUES, max_size=3), st.data())
def test_damage_is_one_line_or_a_map(value: dict[str, Any], data: st.DataObject) -> None:
    good = packed(value | {"a": flax_array(np.arange(4)), "c": flax_chunks(np.arange(6.0).reshape(2, 3), 4)})
    at = data.draw(st.integers(0, len(good) - 1))
    piece = data.draw(st.binary(max_size=6))
    with suppress(InvalidFile):
        assert isinstance(read(good[:at] + piece + good[at + data.draw(st.integers(0, 6)) :]), dict)


@given(st.dictionaries(TEXT, VALUES, min_size=1, max_size=5))
def test_every_truncation_is_refused(value: dict[str, Any]) -> None:
    good = packed(value)
    for end in range(0, len(good), 1 + len(good) // 20):
        refused(good[:end])


# -- parts that are not wanted ---------------------------------------------------------------------------------
def test_skipped_keys_are_left_out_and_never_built() -> None:
    hostile = msgpack.ExtType(9, b"x" * 1000)
    value = {"a": {"state": [hostile, {"x": [b"y", 1.5]}], "target": 1}, "state": 2, "a.state": 3, "at": 4}
    assert read(packed(value), skip=["a.state"]) == {"a": {"target": 1}, "state": 2, "at": 4}
    assert read(packed(value), skip=["a", "at"]) == {"state": 2, "a.state": 3}
    assert "extension of type 9" in refused(packed(value))


def test_what_is_skipped_may_be_deep_but_must_be_complete() -> None:
    deep = b"\x82\xa1a" + b"\x91" * 100_000 + b"\xc0" + b"\xa1b\x01"
    assert read(deep, skip=["a"]) == {"b": 1}
    for data in (deep[:50_000], b"\x81\xa1a\xdf\xff\xff\xff\xff", b"\x81\xa1a\xc7\x01\x01"):
        with pytest.raises(InvalidFile):
            read(data, skip=["a"])


def test_a_skipped_key_counts_when_keys_repeat() -> None:
    with pytest.raises(InvalidFile, match="has the key a twice in a map"):
        read(b"\x82\xa1a\x01\xa1a\x02", skip=["a"])


# -- flax's arrays ---------------------------------------------------------------------------------------------
@pytest.mark.parametrize("dtype", ["f2", "f4", "f8", "i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8", "?"])
def test_arrays_of_every_type_are_read(dtype: str) -> None:
    array = (np.arange(24).reshape(2, 3, 4) % 5 - (dtype[0] not in "u?")).astype(dtype)
    found = read(packed({"a": flax_array(array)}))["a"]
    assert found.dtype == array.dtype
    assert_array_equal(found, array)


def test_an_array_by_hand_is_a_view_of_the_file() -> None:
    data = bytes.fromhex("81 a1 61 c7 10 01 93 91 01 a7") + b"float32" + bytes.fromhex("c4 04 0000c03f")
    data = data.replace(b"\xc7\x10", b"\xc7" + bytes([len(data) - 6]))
    found = read(data)["a"]
    assert_array_equal(found, np.array([1.5], np.float32))
    assert np.shares_memory(found, np.frombuffer(data, np.uint8))


def test_bfloat16_becomes_float32() -> None:
    values = np.array([[1.5, -2.0, 0.15625]], np.float32)  # exact with 8 bits
    bits = (values.view(np.uint32) >> 16).astype("<u2").tobytes()
    found = read(packed({"a": flax([1, 3], "bfloat16", bits)}))["a"]
    assert found.dtype == np.float32
    assert_array_equal(found, values)


def test_bytes_of_a_bool_array_that_are_not_0_or_1_are_true() -> None:
    assert_array_equal(read(packed({"a": flax([3], "bool", b"\0\1\xff")}))["a"].view(np.uint8), [0, 1, 1])


@pytest.mark.parametrize(("dtype", "bits", "value"), [("int32", "<i", 7), ("float64", "<d", 0.1), ("bool", "<?", True)])
def test_numbers_become_pythons(dtype: str, bits: str, value: Any) -> None:
    found = read(packed({"a": flax([], dtype, struct.pack(bits, value), kind=3)}))["a"]
    assert found == value
    assert type(found) is type(value)


@pytest.mark.parametrize("size", [1, 5, 12, 100])
def test_chunks_of_a_large_array_are_joined(size: int) -> None:
    array = np.arange(12, dtype=np.float16).reshape(3, 4)
    found = read(packed({"a": {"kernel": flax_chunks(array, size)}}))["a"]["kernel"]
    assert found.dtype == array.dtype
    assert_array_equal(found, array)


CHUNKS = flax_chunks(np.arange(4), 2)


@pytest.mark.parametrize(
    ("value", "said"),
    [
        (flax([3], "float32", b"x" * 11), "has an array of 11 bytes; allowed: 12 for shape (3,) of float32"),
        (flax([2, 3], "float32", b"x" * 28), "has an array of 28 bytes; allowed: 24 for shape (2, 3) of float32"),
        (flax([2**47] * 8, "float32", b""), "has an array of 0 bytes"),
        (flax([1], "object", b"x" * 8), "has an array of dtype 'object'; allowed: bool, int8, int16"),
        (flax([1], "complex64", b"x" * 8), "has an array of dtype 'complex64'"),
        (flax([1], "<f4", b"x" * 4), "has an array of dtype '<f4'"),
        (flax([0], "int8", b""), "has an invalid shape; allowed: at most 8 edges of 1 or more"),
        (flax([-1], "int8", b"x"), "has an invalid shape"),
        (flax([True], "int8", b"x"), "has an invalid shape"),
        (flax(["1"], "int8", b"x"), "has an invalid shape"),
        (flax([1] * 9, "int8", b"x"), "has an invalid shape"),
        (flax([2**63], "int8", b"x"), "has an invalid shape"),
        (flax(1, "int8", b"x"), "has an array of another form; allowed: [shape, dtype, bytes], as flax writes"),
        (flax([1], b"int8", b"x"), "has an array of another form"),
        (flax([1], "int8", "x"), "has an array of another form"),
        (msgpack.ExtType(1, b""), "ends after 0 bytes; allowed: 1 or more"),
        (msgpack.ExtType(1, packed([[1], "int8", b"x"]) + b"\0"), "has an array of another form"),
        (msgpack.ExtType(1, packed([[1], "int8", b"x"])[:-1]), "declares 1 bytes; allowed: what fits into the 0 bytes"),
        (msgpack.ExtType(1, b"\x93\xdd\xff\xff\xff\xff"), "declares 4,294,967,295 values"),
        (msgpack.ExtType(1, b"\x91" * 1000), "has more than 2 lists and maps inside each other"),
        (flax([1], "int8", flax([1], "int8", b"x")), "has an extension of type 1 inside of an extension"),
        (flax([1], "int32", b"1234", kind=3), "has a number of shape (1,); allowed: ()"),
        (msgpack.ExtType(2, b"12"), "has an extension of type 2; allowed: 1 (an array) or 3 (a number)"),
        (msgpack.Timestamp(1), "has an extension of type -1"),
        (CHUNKS | {"shape": {"0": 5}}, "has chunks of 4 numbers; allowed: 5 for shape (5,)"),
        (CHUNKS | {"shape": {"0": 4, "2": 1}}, "has __msgpack_chunked_array__.shape of another form"),
        (CHUNKS | {"shape": [4]}, "has __msgpack_chunked_array__.shape of another form"),
        ({key: CHUNKS[key] for key in CHUNKS if key != "chunks"}, "has __msgpack_chunked_array__.chunks of another"),
        (CHUNKS | {"chunks": {}}, "has chunks that are not flat arrays of one dtype"),
        (CHUNKS | {"chunks": {"0": 1}}, "has chunks that are not flat arrays of one dtype"),
        (CHUNKS | {"chunks": {"0": flax_array(np.zeros((2, 2)))}}, "has chunks that are not flat arrays of one dtype"),
        (
            CHUNKS | {"chunks": {"0": flax_array(np.zeros(2)), "1": flax_array(np.zeros(2, np.float32))}},
            "has chunks that are not flat arrays of one dtype",
        ),
    ],
)
def test_arrays_that_are_refused(value: Any, said: str) -> None:
    line = refused(packed({"a": value}))
    assert line.startswith("it at byte ")
    assert said in line


# -- hostile files ---------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("code", "said"),
    [
        ("", "it at byte 0 ends after 0 bytes; allowed: 1 or more"),
        ("92 01 02", "it at byte 0 does not begin with a map; allowed: a map that contains everything"),
        ("80 00 00", "it at byte 1 has 2 bytes after the end of the map; allowed: none"),
        ("81 a1 61 c1", "it at byte 3 has the byte c1; allowed: a value of MessagePack"),
        ("81 01 02", "it at byte 1 has a key that is not text; allowed: text"),
        ("81 80 02", "it at byte 1 has a key that is not text; allowed: text"),
        ("82 a1 61 01 a1 61 02", "it at byte 4 has the key a twice in a map; allowed: each key once"),
        ("81 a2 c3 28 01", "it at byte 1 has text that is not UTF-8; allowed: UTF-8"),
        ("81 a1 61 a1 ff", "it at byte 3 has text that is not UTF-8; allowed: UTF-8"),
        ("df ffffffff", "declares 4,294,967,295 pairs; allowed: what fits into the 0 bytes that remain"),
        ("81 a1 61 dd ffffffff 00", "it at byte 3 declares 4,294,967,295 values; allowed: what fits into the 1 bytes"),
        ("81 a1 61 c6 ffffffff 00", "it at byte 3 declares 4,294,967,295 bytes"),
        ("81 a1 61 db ffffffff 00", "it at byte 3 declares 4,294,967,295 bytes"),
        ("81 a1 61 c9 ffffffff 01 00", "it at byte 3 declares 4,294,967,295 bytes"),
        ("81 a1 61 c7 01 01", "it at byte 6 ends after 0 bytes; allowed: 1 or more"),
        ("81 a1 61 cb 00", "it at byte 4 ends after 1 bytes; allowed: 8 or more"),
        ("82 a1 61 01", "declares 2 pairs; allowed: what fits into the 3 bytes that remain"),
    ],
)
def test_what_is_refused_names_the_offset(code: str, said: str) -> None:
    assert said in refused(bytes.fromhex(code))


@pytest.mark.parametrize("opening", [b"\x91", b"\x81\xa1a"])
def test_depth_is_limited(opening: bytes) -> None:
    read(b"\x81\xa1a" + opening * (MAX_DEPTH - 1) + b"\xc0")
    for depth in (MAX_DEPTH, 100_000):
        assert "has more than 64 lists and maps inside each other; allowed: 64 at most" in refused(
            b"\x81\xa1a" + opening * depth + b"\xc0"
        )


@pytest.mark.parametrize("value", [b"\x80", b"\x90", b"\xc0", b"\xc4\x00", b"\xa1x"])
def test_memory_is_counted_before_it_is_used(value: bytes) -> None:
    data = b"\x81\xa1a\xdd" + struct.pack(">I", 50_000) + value * 50_000
    with scope(), memory_limit(1 << 20), pytest.raises(MemoryLimit, match=r"^it needs "):
        read(data)


def test_joined_chunks_are_counted_before_they_are_joined() -> None:
    data = packed({"a": flax_chunks(np.zeros(50_000), 25_000)})
    with scope(), memory_limit(300_000), pytest.raises(MemoryLimit, match=r"^it needs 390\.6 KiB"):
        read(data)


# -- files of other programs -----------------------------------------------------------------------------------
@pytest.mark.data
@pytest.mark.parametrize(("name", "rgb"), [("jaxnerf", "Dense_11"), ("nerfsh", "Dense_9"), ("nerfsg", "Dense_9")])
def test_checkpoints_of_flax(data: Path, name: str, rgb: str) -> None:
    content = (data / "fields" / "jaxnerf" / f"{name}_checkpoint_7").read_bytes()
    root = read(content)
    assert root["optimizer"]["state"]["step"] == 7
    target = read(content, skip=["optimizer.state"])["optimizer"]
    assert list(target) == ["target"]
    raw = msgpack.unpackb(content)["optimizer"]["target"]["params"]["MLP_1"]
    layers = target["target"]["params"]["MLP_1"]
    assert rgb in layers
    assert layers.keys() == raw.keys()
    for layer in layers:
        for key in ("kernel", "bias"):
            shape, dtype, numbers = msgpack.unpackb(raw[layer][key].data)
            assert_array_equal(layers[layer][key], np.frombuffer(numbers, dtype).reshape(shape))


@pytest.mark.data
def test_a_snapshot_as_instant_ngp_lays_it_out(data: Path) -> None:
    content = gzip.decompress((data / "fields" / "untrained.ingp").read_bytes())
    root = read(content)
    assert root == msgpack.unpackb(content)
    assert len(root["snapshot"]["density_grid_binary"]) == 2 * 2 * 128**3
