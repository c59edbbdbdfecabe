"""The one door for JSON."""

from __future__ import annotations

import gc
import json
import subprocess
import sys
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from nerfbake.errors import InvalidFile, MemoryLimit
from nerfbake.formats.wire import json as wire_json
from nerfbake.memory import memory_limit

VALUES: Any = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(2**53), 2**53)
    | st.floats(allow_nan=False, allow_infinity=False)
    | st.text(),
    lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner),
)


@given(VALUES)
def test_what_python_writes_is_read(value: Any) -> None:
    assert wire_json.parse(json.dumps(value).encode(), "it") == value


@pytest.mark.parametrize(
    "text", ["", "1e999", "9" * 400, "[NaN", "nano", '"\\ud800"', "[1,]", "[" * 100_000, '{"a":1', "1 2", '"\xff"']
)
def test_what_breaks_other_readers_is_one_line(text: str) -> None:
    with pytest.raises(InvalidFile, match=r"^it cannot be parsed \(.*\); allowed: one whole JSON document$"):
        wire_json.parse(text.encode("latin-1"), "it")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("NaN", "it is NaN; allowed: a finite number"),
        ('{"a": {"b": [1, [2, -Infinity], NaN]}}', "a.b[1, 1] is -Infinity; allowed: a finite number (and 1 more)"),
        ('[{"NaN, \\"NaN": [[0, {"x y": [nan]}]]}]', '[0].NaN, "NaN[0, 1].x y[0] is nan; allowed: a finite number'),
        (
            '{"?": "Infinity", "a": "??", "i": -nan(ind), "j": inf}',
            "i is -nan(ind); allowed: a finite number (and 1 more)",
        ),
    ],
)
def test_a_number_that_is_none_is_named_with_its_place(text: str, said: str) -> None:
    with pytest.raises(InvalidFile) as caught:
        wire_json.parse(text.encode(), "it")
    assert str(caught.value) == said
    with pytest.raises(InvalidFile) as caught:
        wire_json.parse(text.encode(), "a.json")
    assert str(caught.value) == ("a.json" + said[2:] if said.startswith("it ") else f"a.json: {said}")
    with pytest.raises(InvalidFile) as caught:
        wire_json.parse(f"// NaN\n{text} /* NaN */".encode(), "it", comments=True)
    assert str(caught.value) == said


def test_comments_are_passed_over_where_they_are_allowed() -> None:
    text = b'{"a": "no // comment /* here */", // one\n "b": /* two\n */ 2}'
    assert wire_json.parse(text, "it", comments=True) == {"a": "no // comment /* here */", "b": 2}
    with pytest.raises(InvalidFile):
        wire_json.parse(text, "it")


def test_a_byte_order_mark_is_passed_over() -> None:
    assert wire_json.parse(b"\xef\xbb\xbf{}", "it") == {}


@pytest.mark.parametrize(
    "piece",
    [
        "[],",
        "{},",
        "1,",
        "300,",
        "1.5,",
        "-0.123456789,",
        '"",',
        '"ab",',
        '{"a":[1]},',
        '"\u00e4\u00f6",',
        '"\U0001f600x",',
    ],
)
def test_no_text_takes_more_than_was_settled(piece: str) -> None:
    # What the process really takes on top, in a process of its own.
    code = f"""if True:
        from nerfbake.formats.wire import json as wire_json
        text = ("[" + {piece!r} * (4_000_000 // len({piece!r})) + "0]").encode()
        need = wire_json.size_of_parsed(text).parsing
        peak = lambda: int(open("/proc/self/status").read().split("VmHWM:")[1].split()[0]) * 1024
        before = peak()
        document = wire_json.parse(text, "it")
        print(peak() - before, need)"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    taken, settled = map(int, done.stdout.split())
    assert taken <= settled + (2 << 20)


def test_what_would_take_too_much_is_refused_before_it_is_parsed() -> None:
    with memory_limit(1 << 20), pytest.raises(MemoryLimit, match=r"it, parsed, needs .* MiB; allowed: 1\.0 MiB"):
        wire_json.parse(b"[" + b"[]," * 100_000 + b"0]", "it")


def test_the_collector_is_as_it_was() -> None:
    for enabled in (True, False):
        (gc.enable if enabled else gc.disable)()
        try:
            wire_json.parse(b"[1]", "it")
            with pytest.raises(InvalidFile):
                wire_json.parse(b"[", "it")
            assert gc.isenabled() == enabled
        finally:
            gc.enable()


def test_numbers() -> None:
    fields = {"a": 1, "b": 1.5, "c": "1", "d": True, "e": 10**16, "f": None}
    assert wire_json.number(fields, "a") == 1.0
    assert wire_json.number(fields, "nope", default=3) == 3.0
    assert wire_json.whole(fields, "a", low=0, high=1) == 1
    wrong = {"c": "c is '1'", "d": "d is True", "e": "e is 1", "nope": "nope is missing", "f": "f is"}
    for key, said in wrong.items():
        with pytest.raises(InvalidFile, match=said):
            wire_json.number(fields, key)
    for key in "bcdf":
        with pytest.raises(InvalidFile, match=f"^there.{key} is"):
            wire_json.whole(fields, key, "there", high=100)
    with pytest.raises(InvalidFile, match=r"^a\.json: a is 1; allowed: a number from 2 to 3"):
        wire_json.number(fields, "a", "a.json", low=2, high=3)


def test_tables() -> None:
    np.testing.assert_array_equal(wire_json.table([[1, 2], [3, 4.5]], "it", (None, 2)), [[1, 2], [3, 4.5]])
    for value, said in (
        ([[1, 2], [3]], "it is not a table of numbers"),
        ([["x"]], "it is not a table"),
        ([[None]], r"it\[0, 0\] is null; allowed: a number"),
        ([[1, "1.5"]], r"it\[0, 1\] is text; allowed: a number"),
        ([["-4.0", "2"]], r"it\[0, 0\] is text"),
        ([[0.5, 3, True]], r"it\[0, 2\] is true or false"),
        ([[False]], r"it\[0, 0\] is true or false"),
        ([1, 2], r"it has shape \(2,\); allowed: any x 2 numbers"),
        ([[1, 2e15]], r"it\[0, 1\] is 2e\+15; allowed: -1e\+15 to 1e\+15"),
    ):
        with pytest.raises(InvalidFile, match=said):
            wire_json.table(value, "it", (None, 2) if "shape" in said else (1, None))
    assert wire_json.table(2, "it", ()) == 2
    assert wire_json.table([], "it", (None,)).shape == (0,)
    for single, said in (
        ("2", "it is text"),
        (True, "it is true or false"),
        (2e15, r"it is 2e\+15"),
        ([2], "it has sh"),
    ):
        with pytest.raises(InvalidFile, match=said):
            wire_json.table(single, "it", ())


@given(VALUES)
def test_what_is_shown_of_a_value_is_short(value: Any) -> None:
    assert len(wire_json.shorten(value)) <= 40
