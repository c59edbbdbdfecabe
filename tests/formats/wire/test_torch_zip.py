"""torch's files without torch: every kind of array that they hold, and everything that is refused instead of run."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from nerfbake.errors import InvalidFile, MemoryLimit
from nerfbake.formats.wire.torch import MAX_OPCODES, TorchReader, is_torch, mentions, read_pickle
from nerfbake.formats.wire.torch_writer import (
    Raw,
    TensorView,
    Writer,
    archive,
    glob,
    numpy_array,
    ordered,
    text,
    torch_file,
)
from nerfbake.memory import memory_limit, scope

SIX = np.arange(6, dtype=np.float32)


def read(value: Any, **options: Any) -> tuple[TorchReader, Any]:
    reader = TorchReader(memoryview(torch_file(value, **options)))
    return reader, reader.root


# -- what is read ----------------------------------------------------------------------------------------------
@pytest.mark.parametrize("dtype", ["f8", "f4", "f2", "i8", "i4", "i2", "i1", "u1", "b1"])
def test_tensors_of_every_type_are_read(dtype: str) -> None:
    values = (np.arange(24).reshape(2, 3, 4) % 5 - (dtype[0] not in "ub")).astype(dtype)
    reader, root = read({"a": values, "one": values[1, 1, 1]})
    found = reader.array(root["a"], "a")
    assert found.dtype == dtype
    assert_array_equal(found, values)
    assert reader.array(root["one"], "one").shape == ()
    assert reader.notes == []


def test_views_share_a_storage_and_need_not_lie_together() -> None:
    reader, root = read({"turned": TensorView(SIX, 0, (3, 2), (1, 3)), "part": TensorView(SIX, 1, (2,), (3,))})
    assert_array_equal(reader.array(root["turned"], "turned"), SIX.reshape(2, 3).T)
    assert_array_equal(reader.array(root["part"], "part"), [1, 4])


def test_numbers_of_the_other_byte_order_and_of_16_bits() -> None:
    writer = Writer()
    pickle = b"\x80\x02" + writer.code([SIX, SIX]) + b"."
    big = archive(pickle, [SIX.astype(">f4").tobytes()] * 2, more={"byteorder": b"big"})
    reader = TorchReader(memoryview(big))
    assert_array_equal(reader.array(reader.root[0], "a"), SIX)
    halves = pickle.replace(b"FloatStorage", b"BFloat16Storage", 1)
    reader = TorchReader(memoryview(archive(halves, [(SIX.view(np.uint32) >> 16).astype("<u2").tobytes(), b""])))
    assert_array_equal(reader.array(reader.root[0], "a"), SIX)


def test_numpys_arrays_numbers_and_dicts_of_configurations_are_read() -> None:
    config = glob("mmcv.utils.config", "ConfigDict") + b")\x81q\x05(" + text("k") + b"K\x07uh\x05b"
    mmengine = glob("mmengine.config.config", "ConfigDict") + b"}" + text("k") + b"K\x08s\x85R"
    parameter = glob("torch._utils", "_rebuild_parameter") + b"(" + Writer().code(SIX) + b"\x88}tR"
    reader, root = read(
        {
            "array": numpy_array(np.arange(6, dtype=np.int16).reshape(2, 3)),
            "config": Raw(config),
            "mmengine": Raw(mmengine),
            "ordered": ordered({"b": 1.5, "a": None}),
            "list": [1, -2, 1 << 40, True, (3, "x")],
            3: "three",
        }
    )
    assert_array_equal(reader.array(root["array"], "array"), [[0, 1, 2], [3, 4, 5]])
    assert (root["config"], root["mmengine"]) == ({"k": 7}, {"k": 8})
    assert root["ordered"] == {"b": 1.5, "a": None}
    assert (root["list"], root[3]) == ([1, -2, 1 << 40, True, (3, "x")], "three")
    reader = TorchReader(memoryview(archive(b"\x80\x02" + parameter + b".", [SIX.tobytes()])))
    assert_array_equal(reader.array(reader.root, "p"), SIX)


def test_a_storage_without_its_crc_is_read_with_a_note_and_a_pickle_is_not() -> None:
    data = torch_file({"a": SIX})
    at = data.index(SIX.tobytes())
    reader = TorchReader(memoryview(data[:at] + b"\1" + data[at + 1 :]))
    reader.array(reader.root["a"], "a")
    assert len(reader.notes) == 1
    at = data.index(b"\x80\x02}")
    with pytest.raises(InvalidFile, match=r"data\.pkl has CRC-32"):
        TorchReader(memoryview(data[: at + 2] + b"]" + data[at + 3 :]))


def test_it_is_known_by_its_pickle() -> None:
    assert is_torch(memoryview(torch_file({})))
    assert not is_torch(memoryview(b"PK\3\4"))
    assert mentions(memoryview(torch_file({"planes": 1, "lines": 2})), b"planes", b"lines")
    assert not mentions(memoryview(torch_file({"planes": 1})), b"planes", b"lines")
    assert not mentions(memoryview(b"planes"), b"planes")
    with pytest.raises(InvalidFile, match=r"torch before 1\.6; allowed: .* save it again"):
        TorchReader(memoryview(bytes.fromhex("80028a0a6cfc9c46f9206aa850192e")))


# -- what is refused -------------------------------------------------------------------------------------------
TENSOR = glob("torch._utils", "_rebuild_tensor_v2")
STORAGE = b"(" + text("storage") + glob("torch", "FloatStorage") + text("0") + text("cpu") + b"K\x06tQ"
HOSTILE: dict[str, tuple[bytes, str]] = {
    "system": (glob("os", "system") + text("true") + b"\x85R", "byte 2 names 'os system'; allowed: tensors"),
    "eval": (glob("builtins", "eval") + text("1") + b"\x85R", "names 'builtins eval'"),
    "a dotted name": (glob("torch", "FloatStorage.from_file") + b")R", "names 'torch FloatStorage.from_file'"),
    "a storage is no builder": (glob("torch", "FloatStorage") + b")R", "calls a value that is not a global"),
    "a class is no builder": (glob("numpy", "ndarray") + b")R", "has unexpected arguments for a class"),
    "text is no builder": (text("os") + b")R", "calls a value that is not a global"),
    "arguments are no tuple": (glob("collections", "OrderedDict") + b"]R", "a global and its arguments"),
    "STACK_GLOBAL": (text("os") + text("system") + b"\x93.", "has the opcode 93; allowed: those that torch writes"),
    "INST": (b"(ios\nsystem\n", "has the opcode 69"),
    "OBJ": (b"(" + glob("collections", "OrderedDict") + b"o", "has the opcode 6f"),
    "NEWOBJ_EX": (b")}\x92", "has the opcode 92"),
    "an extension": (b"\x82\x01", "has the opcode 82"),
    "a frame": (b"\x95" + bytes(8), "has the opcode 95"),
    "persid of text": (text("0") + b"Q", "has an invalid storage"),
    "persid of another type": (b"(" + text("module") + text("a") + b"tQ", "has an invalid storage"),
    "a storage of another kind": (STORAGE.replace(b"FloatStorage", b"FloatTensor\0"), "names 'torch FloatTensor"),
    "negative count": (STORAGE.replace(b"K\x06tQ", b"J\xff\xff\xff\xfftQ"), "has an invalid storage"),
    "negative stride": (TENSOR + b"(" + STORAGE + b"K\x00K\x02\x85J\xff\xff\xff\xff\x85tR", "arguments for a tensor"),
    "size and stride apart": (TENSOR + b"(" + STORAGE + b"K\x00K\x02\x85)tR", "has unexpected arguments for a tensor"),
    "a tensor of nothing": (TENSOR + b")R", "has unexpected arguments for a tensor"),
    "state of a number": (b"K\x01}b", "sets the state of a value that has none"),
    "objects in an array": (glob("numpy", "dtype") + text("O") + b"\x85R", "has unexpected arguments for a dtype"),
    "array without its bytes": (numpy_array(SIX).code.replace(b"K\x06", b"K\x07"), "unexpected arguments for an array"),
    "a key that is a list": (b"}(]K\x01u", "items that are not pairs"),
    "items of a list": (b"](K\x01K\x02u", "sets items of a value that is not a dict"),
    "appended to a dict": (b"}K\x01a", "appends to a value that is not a list"),
    "odd items": (b"}(K\x01u", "sets items of a value that is not a dict"),
    "nothing on the stack": (b"R", "pops a value from an empty stack"),
    "no mark": (b"K\x01t", "ends a group without a mark"),
    "a mark is no value": (b"(\x85", "pops a value from an empty stack"),
    "never kept": (b"h\x07", "reads memo entry 7, which was never stored"),
    "protocol 4": (b"\x80\x04", "is of protocol 4"),
    "no UTF-8": (b"X\x02\x00\x00\x00\xff\xff", "not UTF-8"),
    "a name without an end": (b"c" + b"a" * 300, "a name without an end"),
    "cut": (b"X\xff\xff\xff\x7fab", "ends"),
    "endless": (b"N" * (MAX_OPCODES + 1), f"more than {MAX_OPCODES:,} opcodes"),
}  # fmt: skip


@pytest.mark.parametrize("what", HOSTILE)
def test_what_torch_does_not_write_is_refused_with_its_place(what: str) -> None:
    code, said = HOSTILE[what]
    with pytest.raises(InvalidFile) as error:
        read_pickle(b"\x80\x02" + code + b".", "data.pkl")
    assert said in str(error.value)
    assert "data.pkl at byte" in str(error.value)


def test_what_was_kept_is_not_copied_again_and_again() -> None:
    """A list of thousands, of which every five bytes would make a dict."""
    many = b"](" + b"".join(b"K\x01K\x02\x86" for _ in range(5000)) + b"eq\x01\x85q\x02"
    again = glob("collections", "OrderedDict") + b"q\x03h\x02R" + b"h\x03h\x02R" * 20_000
    with pytest.raises(InvalidFile, match="builds more than the file contains"):
        read_pickle(b"\x80\x02" + many + again + b".", "data.pkl")
    pairs = b"(" + b"K\x01K\x02\x86" * 5000 + b"tq\x02"
    with pytest.raises(InvalidFile, match="builds more than the file contains"):
        read_pickle(b"\x80\x02" + pairs + again + b".", "data.pkl")
    items = b"}(" + b"".join(b"M" + k.to_bytes(2, "little") + b"K\x01" for k in range(5000)) + b"u\x85q\x02"
    with pytest.raises(InvalidFile, match="builds more than the file contains"):
        read_pickle(b"\x80\x02" + items + again + b".", "data.pkl")


def test_shapes_of_thousands_of_edges_are_not_multiplied() -> None:
    edges = b"(" + b"K\xff" * 50_000 + b"t"
    for code in (
        TENSOR + b"(" + STORAGE + b"K\x00" + edges + edges + b"tR",
        numpy_array(SIX).code.replace(b"(K\x06t", edges),
    ):
        with pytest.raises(InvalidFile, match=r"has unexpected arguments for (a tensor|an array)"):
            read_pickle(b"\x80\x02" + code + b".", "data.pkl")


def test_a_state_of_itself_ends() -> None:
    loop = glob("collections", "OrderedDict") + b")Rq\x01h\x01b(" + text("me") + b"h\x01u"
    found = read_pickle(b"\x80\x02" + loop + b".", "data.pkl")
    assert found["me"] is found


@pytest.mark.parametrize(
    ("view", "said"),
    [
        (
            TensorView(SIX, 5, (2,), (1,)),
            "a of shape (2,) reaches number 6; allowed: the 6 numbers of its storage",
        ),
        (TensorView(SIX, 0, (2, 2), (1, 5)), "reaches number 6"),
        (TensorView(SIX, 0, (7,), (0,)), "a of shape (7,) reaches number 0"),
        (TensorView(SIX, 0, (1 << 40, 1 << 40), (0, 0)), "reaches number 0"),
        (TensorView(SIX, 0, (0,), (1,)), "a of shape (0,)"),
        (TensorView(SIX, 0, (6,), (1,), numel=7), "data/0 has 24 bytes; allowed: 28 for a"),
    ],
)
def test_tensors_stay_within_their_storage(view: TensorView, said: str) -> None:
    reader, root = read({"a": view})
    with pytest.raises(InvalidFile) as error:
        reader.array(root["a"], "a")
    assert said in str(error.value)


def test_a_storage_that_is_missing_or_packed_is_refused() -> None:
    writer = Writer()
    pickle = b"\x80\x02" + writer.code({"a": SIX}) + b"."
    reader = TorchReader(memoryview(archive(pickle, [])))
    with pytest.raises(InvalidFile, match="a refers to data/0, which is missing"):
        reader.array(reader.root["a"], "a")
    with pytest.raises(InvalidFile, match=r"lists 0 members data\.pkl"):
        TorchReader(memoryview(archive(pickle, [], prefix="x").replace(b"data.pkl", b"data.pkk")))


def test_memory_is_asked_for_before_it_is_taken() -> None:
    writer = Writer()
    pickle = b"\x80\x02" + writer.code({"a": np.zeros(1 << 20, np.float32)}) + b"."
    wide = pickle.replace(b"FloatStorage", b"BFloat16Storage")
    with memory_limit(1 << 20), scope():
        reader = TorchReader(memoryview(archive(wide, [bytes(1 << 21)])))
        with pytest.raises(MemoryLimit):
            reader.array(reader.root["a"], "a")


# -- torch itself ----------------------------------------------------------------------------------------------
SAVES = """
import json, sys, torch, collections
random = torch.Generator().manual_seed(0)
whole = torch.randn(3, 4, generator=random)
values = {
    "whole": whole, "turned": whole.t(), "part": whole[1:, ::2], "half": whole.half(), "bfloat": whole.bfloat16(),
    "long": torch.arange(5), "flag": whole > 0, "one": torch.tensor(2.5), "parameter": torch.nn.Parameter(whole),
}
state = torch.nn.Linear(3, 2).state_dict()
torch.save({"values": values, "model_state_dict": state, "model_kwargs": {"a": 1, "b": [None, 2.5]}}, sys.argv[1])
print(json.dumps({name: value.float().tolist() for name, value in {**values, **state}.items()}))
"""


@pytest.mark.tools
@pytest.mark.slow
def test_what_torch_saves_is_read(torch: str, tmp_path: Path) -> None:
    done = subprocess.run([torch, "-c", SAVES, str(tmp_path / "a.pt")], capture_output=True, check=True, timeout=120)
    expected = json.loads(done.stdout)
    reader = TorchReader(memoryview((tmp_path / "a.pt").read_bytes()))
    found = reader.root["values"] | reader.root["model_state_dict"]
    assert found.keys() == expected.keys()
    for name, value in expected.items():
        assert_array_equal(reader.array(found[name], name).astype(np.float64), value)
    assert reader.root["model_kwargs"] == {"a": 1, "b": [None, 2.5]}


@pytest.mark.tools
@pytest.mark.slow
def test_torch_reads_what_is_written(torch: str, tmp_path: Path) -> None:
    (tmp_path / "a.pt").write_bytes(torch_file({"a": TensorView(SIX, 0, (3, 2), (1, 3)), "b": numpy_array(SIX)}))
    loads = "import sys, torch; a = torch.load(sys.argv[1]); print(a['a'].tolist(), a['b'].tolist())"
    done = subprocess.run([torch, "-c", loads, str(tmp_path / "a.pt")], capture_output=True, check=True, timeout=120)
    assert done.stdout.decode().split("\n")[0] == f"{SIX.reshape(2, 3).T.tolist()} {SIX.tolist()}"
