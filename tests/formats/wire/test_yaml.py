"""YAML as plain values: what PyYAML writes, what nerfstudio writes, and what a hostile author writes."""

from __future__ import annotations

import re
from contextlib import suppress
from pathlib import Path, PurePosixPath
from types import SimpleNamespace
from typing import Any

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from nerfbake.errors import InvalidFile, MemoryLimit
from nerfbake.formats.wire.yaml import MAX_BYTES, MAX_DEPTH, parse_map
from nerfbake.memory import memory_limit, scope


def read(text: str | bytes) -> dict[Any, Any]:
    return parse_map(memoryview(text.encode() if isinstance(text, str) else text), "it")


def refused(text: str | bytes) -> str:
    with pytest.raises(InvalidFile) as caught:
        read(text)
    return str(caught.value)


# -- what is read ----------------------------------------------------------------------------------------------
def test_a_file_by_hand() -> None:
    text = """\
%YAML 1.1
--- # a comment
!!python/object:nerfstudio.Config
_target: &id001 !!python/name:torch.optim.adam.Adam ''
again: *id001
path: !!python/object/apply:pathlib.PosixPath
- /
- data
pair: !!python/tuple [1, 2.5]
flow: {a: [x, 'it''s', "\\x41\\n"], b: , c}
shared: &id002
  list:
  - - nested
    - ~
  - k: v
    l: w
other: *id002
long: first
  second

  third
literal: |
  one
   two
folded: >-
  one
  two
...
"""
    found = read(text)
    assert found == {
        "_target": "",
        "again": "",
        "path": ["/", "data"],
        "pair": [1, 2.5],
        "flow": {"a": ["x", "it's", "A\n"], "b": None, "c": None},
        "shared": {"list": [["nested", None], {"k": "v", "l": "w"}]},
        "other": {"list": [["nested", None], {"k": "v", "l": "w"}]},
        "long": "first second\nthird",
        "literal": "one\n two\n",
        "folded": "one two",
    }
    assert found["shared"] is found["other"]


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("5", 5),
        ("-5", -5),
        ("0x1F", 31),
        ("010", 8),
        ("1_000", 1000),
        ("1:30", 90),
        ("1.5", 1.5),
        ("1.0e-15", 1e-15),
        (".5", 0.5),
        (".inf", float("inf")),
        ("1e-3", "1e-3"),  # a float needs a point
        ("1.0e5", "1.0e5"),  # and its exponent a sign
        ("true", True),
        ("Off", False),
        ("y", "y"),
        ("null", None),
        ("", None),
        ("'5'", "5"),
        ('"true"', "true"),
        ("!!int 5", "5"),
        ("! 5", "5"),
        ("2020-01-01", "2020-01-01"),
        ("=", "="),
        ("!!python/object/apply:os.system [exit 1]", ["exit 1"]),
        ("!!python/object/new:os.system {args: [exit 1]}", {"args": ["exit 1"]}),
        ("!!python/module:antigravity ''", ""),
        ("!!python/name:os.system", ""),
        ("!<tag:x,2000:any> text", "text"),
    ],
)
def test_scalars_are_what_pyyaml_makes_of_them_and_tags_are_ignored(text: str, value: Any) -> None:
    found = read(f"a: {text}")["a"]
    assert found == value
    assert type(found) is type(value)


# PyYAML writes the excluded ones in a way that it reads as other line breaks.
TEXT = st.text(st.characters(codec="utf-8", exclude_characters="\x85\u2028\u2029"), max_size=12)
SCALARS = st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | TEXT
VALUES: Any = st.recursive(
    SCALARS,
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(TEXT, inner, max_size=4),
    max_leaves=8,
)


@given(
    st.dictionaries(TEXT, VALUES, max_size=4),
    st.sampled_from([None, False, True]),
    st.sampled_from([None, "'", '"', "|", ">"]),
    st.sampled_from([20, 80]),
)
def test_what_pyyaml_writes_is_read(value: dict[str, Any], flow: bool | None, style: str | None, width: int) -> None:
    text = yaml.dump(value, default_flow_style=flow, default_style=style, width=width, allow_unicode=True)
    expected = yaml.safe_load(text)
    if style is None:
        assert read(text) == expected
    else:  # PyYAML writes `!!int "5"`, of which the text remains
        assert read(text).keys() == expected.keys()
    assert read(yaml.dump({"a": [value, value]}))["a"] == [value, value]


@given(st.dictionaries(TEXT, VALUES, min_size=1, max_size=4), st.data())
def test_damage_is_one_line_or_a_map(value: dict[str, Any], data: st.DataObject) -> None:
    shared = [value]
    good = yaml.dump({"a": (shared, shared), "b": value, "c": 1.5, "d": "word " * 30}).encode()
    at = data.draw(st.integers(0, len(good) - 1))
    piece = data.draw(
        st.binary(max_size=4) | st.sampled_from([b"*a", b"&a ", b"- ", b"? ", b"[", b"{", b"\n", b"!!", b": "])
    )
    with suppress(InvalidFile):
        assert isinstance(read(good[:at] + piece + good[at + data.draw(st.integers(0, 4)) :]), dict)


def test_objects_that_python_dumps_are_maps_lists_and_text() -> None:
    lists = [1, 2]
    config = SimpleNamespace(target=PurePosixPath, where=PurePosixPath("/a/b"), pair=(1, 2), lists=[lists, lists])
    found = read(yaml.dump(vars(config)))
    assert found == {"target": "", "where": ["/", "a", "b"], "pair": [1, 2], "lists": [[1, 2], [1, 2]]}
    assert found["lists"][0] is found["lists"][1]


# -- hostile files ---------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "it does not contain a map; allowed: one map"),
        ("- a", "it does not contain a map; allowed: one map"),
        (b"a: \xff", "it is not UTF-8; allowed: UTF-8"),
        ("a: 1\n---\nb: 2", "it at line 2 has a second document; allowed: one document"),
        ("a: 1\nb: 2\na: 3", "it at line 3 has the key a twice in a map; allowed: each key once"),
        ("? [a]\n: b", "it at line 1 has a key that is a list or a map; allowed: text"),
        ("a: &x [1]\n*x : b", "it at line 2 has a key that is a list or a map; allowed: text"),
        ("a:\n  <<: {b: 1}", "it at line 2 has a merge key (<<); allowed: each map with all its keys"),
        ("a: *x", "it at line 1 refers to the anchor x, which is missing; allowed: an anchor before it"),
        ("a: 1\nb: &x\n- *x", "it at line 3 refers to the anchor x inside of its own value; allowed: no cycle"),
        ("&x a: *x\nb: &x {c: *x}", "it at line 2 refers to the anchor x inside of its own value"),
        ("a: 1\n b: 2", "it at line 2 cannot be parsed (mapping values are not allowed here); allowed: YAML 1.1"),
        ("a: [1, 2", "it at line 1 cannot be parsed (expected ',' or ']', but got '<stream end>')"),
        ("a: 'text", "it at line 1 cannot be parsed (found unexpected end of stream)"),
        ("a: \0", "cannot be parsed (unacceptable character #x0000: special characters are not allowed)"),
        ('a: "\\UFFFFFFFF"', "it at line 1 cannot be parsed; allowed: YAML 1.1"),
        ("%YAML " + "1" * 5000 + ".1\n--- {}", "it at line 1 cannot be parsed; allowed: YAML 1.1"),
        ('a: "\\ud800"', "it at line 1 has text that is not Unicode; allowed: Unicode"),
        ("a: 0x_", "it at line 1 has the number '0x_', which has no digits; allowed: a number"),
        ("a: 0x" + "f" * 99, "it at line 1 has a number of 101 characters; allowed: 100 at most"),
        ("a: " + "9" * 5000, "it at line 1 has a number of 5,000 characters; allowed: 100 at most"),
        ("#" * (MAX_BYTES + 1), "it has 65,537 bytes; allowed: 65,536 at most"),
    ],
)
def test_what_is_refused_names_the_line(text: str | bytes, said: str) -> None:
    assert said in refused(text)


@pytest.mark.parametrize("opening", ["[", "{a: ", "? ", "- "])
def test_depth_is_limited(opening: str) -> None:
    start = "a:\n " if opening in "? - " else "a: "
    for depth in (MAX_DEPTH, 2_000):
        assert "has more than 64 lists and maps inside each other; allowed: 64 at most" in refused(
            start + opening * depth
        )
    with suppress(InvalidFile):  # the end of the file is missing
        read(start + opening * (MAX_DEPTH - 1))


def test_depth_counts_through_aliases() -> None:
    inner = "a: &a " + "[" * 40 + "]" * 40
    assert read(f"{inner}\nb: {'[' * 23}*a{']' * 23}")["b"]
    assert "has more than 64 lists and maps inside each other" in refused(f"{inner}\nb: {'[' * 24}*a{']' * 24}")


def test_aliases_of_aliases_are_counted_as_often_as_they_are_met() -> None:
    laughs = [f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 10)}]" for i in range(1, 10)]
    assert "it at line 6 has " in refused("\n".join(["a0: &a0 [x, x, x, x, x, x, x, x, x, x]", *laughs]))
    long = "a: &a " + "x" * 20_000
    assert "values and characters or more, with aliases resolved; allowed: 1,048,576 at most" in refused(
        f"{long}\nb: [{'*a, ' * 60}]"
    )
    assert len(read(f"{long}\nb: [{'*a, ' * 50}]")["b"]) == 50


def test_memory_is_counted_before_it_is_used() -> None:
    with scope(), memory_limit(1 << 20), pytest.raises(MemoryLimit, match=r"^it, parsed, needs 1\.5 MiB"):
        read("a: [" + "?," * 5_000 + "]")


# -- files of other programs -----------------------------------------------------------------------------------
@pytest.mark.data
def test_the_configuration_of_a_run_of_nerfstudio(data: Path) -> None:
    text = (data / "fields" / "nerfacto_object" / "config.yml").read_bytes()
    found = read(text)
    model = found["pipeline"]["model"]
    assert found["method_name"] == "nerfacto"
    assert {key: model[key] for key in ("average_init_density", "base_res", "background_color", "far_plane")} == {
        "average_init_density": 0.01,
        "base_res": 16,
        "background_color": "random",
        "far_plane": 1000.0,
    }
    assert model["disable_scene_contraction"] is False
    assert model["num_proposal_samples_per_ray"] == [64, 32]
    assert found["optimizers"]["fields"]["scheduler"]["lr_pre_warmup"] == 1e-8
    assert found["relative_model_dir"] == ["nerfstudio_models"]
    # PyYAML reads the same from the text without tags.
    assert found == yaml.safe_load(re.sub(rb"!!python/\S+", b"", text))
