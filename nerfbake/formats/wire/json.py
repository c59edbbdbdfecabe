"""JSON, read as if a stranger had sent it: the one door for every file that holds some.

orjson refuses what breaks others: numbers beyond a double (1e999, 400 digits), NaN, text beyond Unicode, nesting beyond
1024. What Python's objects for a text can take is settled from its punctuation before anything is parsed, and the
garbage collector waits meanwhile: going through millions of new lists again and again takes longer than parsing.
"""

from __future__ import annotations

import gc
import math
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import orjson

from nerfbake import memory
from nerfbake.errors import InvalidFile, Problem

MAX_NUMBER = 1e15  # of a length, a pixel or a weight: beyond it double precision has no digits for what it is added to
_CHUNK = 1 << 18
# Bytes of Python's objects: 44 for a number with its slot in a list that grows; more for a list, an object, text. And
# of orjson's own tree, which is there beside them while it parses: 16 a value.
_PER_VALUE, _PER_CONTAINER, _PER_NODE = 44, 128, 16
_BOM = b"\xef\xbb\xbf"
_COMMENT = re.compile(rb'("(?:[^"\\]|\\.)*+")|//[^\n]*|/\*(?:.*?\*/|.*)', re.DOTALL)


def parse(view: memoryview | bytes, name: str, *, comments: bool = False) -> Any:
    """The document, as Python's own types. comments: // and /* */ are passed over, as instant-ngp's files have them.

    Its memory is taken until the end of the file's reading. Raises InvalidFile, MemoryLimit.
    """
    size = size_of_parsed(view)
    memory.require(f"{name}, parsed,", size.parsing)
    memory.hold(f"{name}, parsed,", size.parsed)
    text: memoryview | bytes = view[3:] if bytes(view[:3]) == _BOM else view
    with collector_paused():
        try:
            return orjson.loads(text)
        except orjson.JSONDecodeError as error:
            fault = error
        if comments and b"/" in (whole := bytes(text)):
            try:
                return orjson.loads(_COMMENT.sub(lambda found: found[1] or b" ", whole))
            except orjson.JSONDecodeError as error:
                fault = error
    raise InvalidFile(Problem(name, f"cannot be parsed ({fault})", "one whole JSON document"))


def parse_object(view: memoryview | bytes, name: str, *, comments: bool = False) -> dict[str, Any]:
    """The same for a document that is an object."""
    document = parse(view, name, comments=comments)
    if not isinstance(document, dict):
        raise InvalidFile(Problem(name, f"holds {kind_of(document)}", "an object"))
    return document


def kind_of(value: Any) -> str:
    """What a reader of JSON calls a value."""
    kinds = {dict: "an object", list: "a list", str: "text", bool: "true or false", type(None): "null"}
    return kinds.get(type(value), "a number")


def number(
    fields: Mapping[str, Any],
    key: str,
    place: str = "",
    *,
    default: float | None = None,
    low: float = -MAX_NUMBER,
    high: float = MAX_NUMBER,
) -> float:
    """A finite number from low to high; `place` names the object that it stands in."""
    value = fields.get(key, default)
    if type(value) not in (int, float) or not low <= value <= high:
        found = "is missing" if value is None else f"is {shown(value)}"
        raise InvalidFile(Problem(within(place, key), found, f"a number from {low:g} to {high:g}"))
    return float(value)


def whole(
    fields: Mapping[str, Any], key: str, place: str = "", *, default: int | None = None, low: int = 0, high: int
) -> int:
    """A whole number from low to high."""
    value = fields.get(key, default)
    if type(value) is not int or not low <= value <= high:
        found = "is missing" if value is None else f"is {shown(value)}"
        raise InvalidFile(Problem(within(place, key), found, f"a whole number from {low:,} to {high:,}"))
    return value


def table(value: Any, place: str, shape: tuple[int | None, ...]) -> npt.NDArray[np.float64]:
    """Nested lists of numbers as an array of this shape, None for an edge of any length."""
    allowed = f"{' x '.join('any' if edge is None else str(edge) for edge in shape)} numbers"
    try:
        with collector_paused():
            array = np.array(value, np.float64)
    except (ValueError, TypeError, OverflowError):
        raise InvalidFile(Problem(place, "is no table of numbers", allowed)) from None
    if array.ndim != len(shape) or any(a not in (None, b) for a, b in zip(shape, array.shape, strict=True)):
        raise InvalidFile(Problem(place, f"has shape {array.shape}", allowed))
    if (bad := ~(np.abs(array) <= MAX_NUMBER)).any():
        index = np.unravel_index(int(bad.argmax()), array.shape)
        where = f"{place}[{', '.join(map(str, index))}]"
        raise InvalidFile(Problem(where, f"is {array[index]:g}", f"{-MAX_NUMBER:g} to {MAX_NUMBER:g}"))
    return array


def shown(value: Any) -> str:
    """A value as a message shows it, at most 40 characters long however long it is."""
    if isinstance(value, int) and not isinstance(value, bool) and abs(value) >= 1 << 64:
        return f"a number of about {int(math.log10(abs(value)))} digits"
    return str(value)[:40] if isinstance(value, str | int | float | bool | None) else kind_of(value)


class Size(NamedTuple):
    """Most bytes that a text can take: while it is parsed, and as Python's objects."""

    parsing: int
    parsed: int


def size_of_parsed(view: memoryview | bytes) -> Size:
    """What the text's punctuation announces, and the text itself, whose characters may take 1, 2 or 4 bytes each."""
    text = np.frombuffer(view, np.uint8)
    counts = np.zeros(256, np.int64)
    for start in range(0, len(text), _CHUNK):
        counts += np.bincount(text[start : start + _CHUNK], minlength=256)
    values = int(counts[[ord(","), ord(":")]].sum())
    containers = int(counts[[ord("["), ord("{"), ord('"')]].sum())
    width = 4 if counts[0xF0:].any() else 2 if counts[0xC4:].any() else 1
    parsed = width * len(text) + _PER_VALUE * values + _PER_CONTAINER * containers
    return Size(parsed + len(text) + _PER_NODE * (values + containers), parsed)


@contextmanager
def collector_paused() -> Iterator[None]:
    """No garbage collection inside the block; before and after as it was."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


def within(place: str, key: str) -> str:
    """A key as a message names it, in the object at this place."""
    if place.endswith(".json"):
        return f"{place}: {key}"
    return f"{place}.{key}" if place else key
