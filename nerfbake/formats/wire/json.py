"""Read untrusted JSON. All formats that contain JSON use this module.

orjson rejects numbers beyond a double (1e999, 400 digits), NaN, text that is not Unicode, and nesting beyond 1024. The
memory of the Python objects is estimated from the text's punctuation before parsing. The garbage collector is paused
while parsing: traversing millions of new lists repeatedly takes longer than parsing them.
"""

from __future__ import annotations

import gc
import math
import re
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from itertools import chain
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import orjson

from nerfbake import memory
from nerfbake.errors import InvalidFile, Problem

MAX_NUMBER = 1e15  # lengths, pixels, weights: a double beyond it has no digits left for what is added to it
_CHUNK = 1 << 18
# Bytes of Python objects: 44 for a number with its slot in a growing list; more for a list, an object, text. While it
# parses, orjson also keeps its tree in memory: 16 bytes a value.
_PER_VALUE, _PER_CONTAINER, _PER_NODE = 44, 128, 16
_BOM = b"\xef\xbb\xbf"
# NaN and infinity outside of text, as Python, NumPy and C write them.
_NO_NUMBER = re.compile(rb'("(?:[^"\\]|\\.)*+")|([-+]?(?:nan|inf(?:inity)?)\b(?:\(\w*\))?)', re.DOTALL | re.IGNORECASE)
_COMMENT = re.compile(rb'("(?:[^"\\]|\\.)*+")|//[^\n]*|/\*(?:.*?\*/|.*)', re.DOTALL)


def parse(view: memoryview | bytes, name: str, *, comments: bool = False) -> Any:
    """Parse a document to Python types. comments: skip // and /* */, which instant-ngp's files contain.

    The memory counts as used until the file has been read. Raises InvalidFile, MemoryLimit.
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
            text = _COMMENT.sub(lambda found: found[1] or b" ", whole)
            try:
                return orjson.loads(text)
            except orjson.JSONDecodeError as error:
                fault = error
        if problem := _no_number(bytes(text), name):
            raise InvalidFile(problem)
    raise InvalidFile(Problem(name, f"cannot be parsed ({fault})", "one whole JSON document"))


def _no_number(text: bytes, name: str) -> Problem | None:
    """Return the first NaN or infinity of a document that is valid apart from such numbers, else None."""
    found: list[str] = []
    mark = b"?"
    while mark in text:
        mark += b"?"

    def replaced(token: re.Match[bytes]) -> bytes:
        if token[1]:
            return token[1]
        found.append(token[2].decode())
        return b'"%s"' % mark if len(found) == 1 else b"0"

    marked = _NO_NUMBER.sub(replaced, text)
    if not found:
        return None
    try:
        place = _place_of(mark.decode(), orjson.loads(marked))
    except orjson.JSONDecodeError:
        return None
    within = f"{name}: {place}" if name.endswith(".json") else place
    return Problem(within if place else name, f"is {found[0]}", "a finite number", len(found))


def _place_of(mark: str, document: Any) -> str:
    """Return the path of the value `mark` in a document, such as frames[3].transform_matrix[0, 2]."""
    waiting = [(document, "", False)]
    while waiting:
        value, place, listed = waiting.pop()
        if value == mark:
            return place
        if isinstance(value, dict):
            waiting += [(each, key_place(place, shorten(key)), False) for key, each in value.items()]
        elif isinstance(value, list):
            start = f"{place[:-1]}, " if listed else f"{place}["
            waiting += [(each, f"{start}{i}]", True) for i, each in enumerate(value)]
    return ""


def parse_object(view: memoryview | bytes, name: str, *, comments: bool = False) -> dict[str, Any]:
    """Parse a document that must be an object."""
    document = parse(view, name, comments=comments)
    if not isinstance(document, dict):
        raise InvalidFile(Problem(name, f"holds {kind_of(document)}", "an object"))
    return document


def kind_of(value: Any) -> str:
    """The JSON name of a value's type, for messages."""
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
    """Return a field as a finite number from low to high; `place` is the name of the object in messages."""
    value = fields.get(key, default)
    if type(value) not in (int, float) or not low <= value <= high:
        found = "is missing" if value is None else f"is {shorten(value)}"
        raise InvalidFile(Problem(key_place(place, key), found, f"a number from {low:g} to {high:g}"))
    return float(value)


def whole(
    fields: Mapping[str, Any], key: str, place: str = "", *, default: int | None = None, low: int = 0, high: int
) -> int:
    """Return a field as an integer from low to high."""
    value = fields.get(key, default)
    if type(value) is not int or not low <= value <= high:
        found = "is missing" if value is None else f"is {shorten(value)}"
        raise InvalidFile(Problem(key_place(place, key), found, f"a whole number from {low:,} to {high:,}"))
    return value


def table(value: Any, place: str, shape: tuple[int | None, ...]) -> npt.NDArray[np.float64]:
    """Convert nested lists of numbers to an array of this shape; None stands for any length, () for a single number."""
    allowed = f"{' x '.join('any' if edge is None else str(edge) for edge in shape)} numbers"
    try:
        with collector_paused():
            array = np.array(value, np.float64)
    except (ValueError, TypeError, OverflowError):
        raise InvalidFile(Problem(place, "is not a table of numbers", allowed)) from None
    if array.ndim != len(shape) or any(a not in (None, b) for a, b in zip(shape, array.shape, strict=True)):
        raise InvalidFile(Problem(place, f"has shape {array.shape}", allowed))
    if not set(map(type, _leaves(value, len(shape)))) <= {int, float}:  # NumPy also converts text, true and null
        kinds = enumerate(_leaves(value, len(shape)))
        at, leaf = next((at, leaf) for at, leaf in kinds if type(leaf) not in (int, float))
        raise InvalidFile(Problem(_element(place, at, array.shape), f"is {kind_of(leaf)}", "a number"))
    if (bad := ~(np.abs(array) <= MAX_NUMBER)).any():
        at = int(bad.argmax())
        found = f"is {array.flat[at]:g}"
        raise InvalidFile(Problem(_element(place, at, array.shape), found, f"{-MAX_NUMBER:g} to {MAX_NUMBER:g}"))
    return array


def _leaves(value: Any, depth: int) -> Iterable[Any]:
    """Iterate over the innermost values of lists of this depth; depth 0 is the value itself."""
    leaves: Iterable[Any] = (value,)
    for _ in range(depth):
        leaves = chain.from_iterable(leaves)
    return leaves


def _element(place: str, at: int, shape: tuple[int, ...]) -> str:
    """The place of the element number `at` of a table, counted row by row."""
    index = ", ".join(str(int(edge)) for edge in np.unravel_index(at, shape))
    return f"{place}[{index}]" if shape else place


def shorten(value: Any) -> str:
    """A value as text for messages, at most 40 characters long. Text without a letter is quoted: it is no number."""
    if isinstance(value, int) and not isinstance(value, bool) and abs(value) >= 1 << 64:
        return f"a number of about {int(math.log10(abs(value)))} digits"
    if isinstance(value, str) and not any(map(str.isalpha, value[:40])):
        return repr(value[:38])
    return str(value)[:40] if isinstance(value, str | int | float | bool | None) else kind_of(value)


class ParsedSize(NamedTuple):
    """Upper bounds of the memory for a text in bytes: while it is parsed, and as Python objects."""

    parsing: int
    parsed: int


def size_of_parsed(view: memoryview | bytes) -> ParsedSize:
    """Bound the memory for a text by its punctuation and its length; a character takes 1, 2 or 4 bytes."""
    text = np.frombuffer(view, np.uint8)
    counts = np.zeros(256, np.int64)
    for start in range(0, len(text), _CHUNK):
        counts += np.bincount(text[start : start + _CHUNK], minlength=256)
    values = int(counts[[ord(","), ord(":")]].sum())
    containers = int(counts[[ord("["), ord("{"), ord('"')]].sum())
    width = 4 if counts[0xF0:].any() else 2 if counts[0xC4:].any() else 1
    parsed = width * len(text) + _PER_VALUE * values + _PER_CONTAINER * containers
    return ParsedSize(parsed + len(text) + _PER_NODE * (values + containers), parsed)


@contextmanager
def collector_paused() -> Iterator[None]:
    """Pause garbage collection inside the block."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


def key_place(place: str, key: str) -> str:
    """The name of a key in messages, for the object at this place."""
    if place.endswith(".json"):
        return f"{place}: {key}"
    return f"{place}.{key}" if place else key
