"""Where a piece of work stands, as bytes."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from nerfbake.errors import InvalidFile, NerfbakeError
from nerfbake.formats.wire.checkpoint import decode_checkpoint, encode_checkpoint
from nerfbake.formats.wire.npz import write_npz
from nerfbake.memory import memory_limit
from tests.support.hostile import damaged

FACTS = {"seed": 3, "curve": [[1.5, None]], "scene": "chair"}
ARRAYS = {"rows": np.arange(6, dtype=np.int32).reshape(2, 3), "values": np.ones((4, 2), np.float32)}


def archive(arrays: dict[str, Any]) -> memoryview:
    return memoryview(b"".join(bytes(piece) for piece in write_npz(arrays)))


def whole() -> memoryview:
    return memoryview(b"".join(bytes(piece) for piece in encode_checkpoint(FACTS, ARRAYS)))


def test_what_is_kept_comes_back() -> None:
    facts, arrays = decode_checkpoint(whole())
    assert facts == FACTS
    assert arrays.keys() == ARRAYS.keys()
    for name, array in ARRAYS.items():
        assert_array_equal(arrays[name], array)
        assert arrays[name].dtype == array.dtype


@pytest.mark.parametrize(
    ("arrays", "said"),
    [
        ({}, "npz has no facts"),
        ({"facts": np.ones(3)}, "facts has dtype float64"),
        ({"facts": np.frombuffer(b"[1]", np.uint8)}, "facts holds a list; allowed: an object"),
        ({"facts": np.frombuffer(b"{", np.uint8)}, "facts cannot be parsed"),
        ({"facts": np.frombuffer(b"{}", np.uint8), "rows": np.array(["a"])}, "rows has dtype <U1; allowed: numbers"),
    ],
)
def test_what_is_no_checkpoint_is_refused(arrays: dict[str, Any], said: str) -> None:
    with pytest.raises(InvalidFile, match=said):
        decode_checkpoint(archive(arrays))


def test_objects_are_not_unpickled() -> None:
    facts = np.frombuffer(json.dumps({}).encode(), np.uint8)
    data = bytes(archive({"facts": facts, "rows": np.zeros(2, "<i8")})).replace(b"'<i8'", b"'|O' ")
    with pytest.raises(NerfbakeError):
        decode_checkpoint(memoryview(data))


def test_a_damaged_checkpoint_is_one_line_or_arrays_of_numbers() -> None:
    with memory_limit(1 << 20):
        for what, data in damaged(bytes(whole()), flips=400):
            try:
                _, arrays = decode_checkpoint(memoryview(data))
            except NerfbakeError:
                continue
            assert all(array.dtype.kind in "biuf" for array in arrays.values()), what
