r"""Read the header and the elements of .ply files, of splats and of meshes: binary in both byte orders, and text.

    ply\n format FORMAT 1.0\n comment ...\n element NAME COUNT\n property TYPE NAME\n
    property list TYPE TYPE NAME\n ... end_header\n | rows of the first element | rows of the second | ...

A row has its properties one behind the other; of a list first the length. In text each row is a line. Lines of the
header end with \n, \r\n or, from the first Macintoshes, \r.

Source: Greg Turk, The PLY Polygon File Format (1994).
"""

from __future__ import annotations

import warnings
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake import memory
from nerfbake.errors import InvalidFile, Problem

Table = npt.NDArray[Any]
_HEADER = 1 << 20  # bytes
TEXT = "ascii"
ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">"}
_TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4",
    "float": "f4", "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2",
    "int32": "i4", "uint32": "u4", "float32": "f4", "float64": "f8",
    "half": "f2", "float16": "f2",
}  # fmt: skip
_DIGITS = 18  # of a count: it fits in 64 bits
_FEW = 1 << 17  # rows with lists of different lengths that are skipped one by one
_ALLOWED = "a whole .ply"


class Property(NamedTuple):
    """A property of an element. kind: its NumPy type; counts: that of a list's length, None for a single number."""

    name: str
    kind: str
    counts: str | None = None


class Element(NamedTuple):
    """An element with its number of rows."""

    name: str
    rows: int
    properties: list[Property]

    @property
    def lists(self) -> bool:
        return any(each.counts for each in self.properties)

    @property
    def numbers(self) -> list[tuple[str, str]]:
        """Name and NumPy type of each property that is not a list."""
        return [(each.name, each.kind) for each in self.properties if not each.counts]


class Header(NamedTuple):
    """The header of a file.

    kind     TEXT, or one of ORDERS
    end      the offset of the first row
    unknown  lines that start with no word of the format: Blender 2.47 wrote comments without the word
    """

    elements: list[Element]
    comments: list[str]
    kind: str
    end: int
    unknown: list[str]

    def element(self, name: str) -> Element | None:
        """The element of this name; None if there is none."""
        return next((each for each in self.elements if each.name == name), None)


class Ply(NamedTuple):
    """The contents of a file.

    properties  the names of each element's properties
    comments    the comments, without the word
    tables      the rows of the wanted elements, structured by their properties
    """

    properties: dict[str, list[str]]
    comments: list[str]
    tables: dict[str, Table]


def recognise(view: memoryview) -> bool:
    """Return True for the first line of a .ply."""
    return bytes(view[:4]) in (b"ply\n", b"ply\r")


def parse(view: memoryview, *wanted: str) -> Ply:
    """Read the elements of these names. Raises InvalidFile, MemoryLimit.

    Other elements are skipped. A wanted element must not have lists.
    """
    elements, comments, kind, at, unknown = parse_header(view)
    for line in unknown:
        raise _strange(line)
    found = {element.name: [each.name for each in element.properties] for element in elements}
    tables: dict[str, Table] = {}
    rows = _Text(view, at) if kind == TEXT else _Binary(view, at, ORDERS[kind])
    last = max((i for i, element in enumerate(elements) if element.name in wanted), default=-1)
    for element in elements[: last + 1]:
        if element.name not in wanted:
            rows.skip(element)
        elif element.lists:
            raise InvalidFile(Problem(f"element {element.name}", "has lists", "numbers only"))
        elif element.properties:
            tables[element.name] = rows.table(element)
    return Ply(found, comments, tables)


def parse_header(view: memoryview) -> Header:
    """Parse the header. Raises InvalidFile."""
    head = bytes(view[:_HEADER])
    if head[3:4] == b"\r" and head[4:5] != b"\n":
        head = head.replace(b"\r", b"\n")
    end = max(head.find(b"\nend_header"), 0)
    stop = head.find(b"\n", end + 1)
    if not recognise(view) or not end or stop < 0:
        raise InvalidFile(Problem("the header", f"does not end within {_HEADER:,} bytes", _ALLOWED))
    elements: dict[str, Element] = {}
    comments: list[str] = []
    unknown: list[str] = []
    found = ""
    last: Element | None = None
    for line in head[:end].decode("latin-1").split("\n")[1:]:
        match line.split():
            case ["format", kind, "1.0"] if kind == TEXT or kind in ORDERS:
                found = kind
            case ["element", name, count] if count.isascii() and count.isdigit() and len(count) <= _DIGITS:
                if name in elements:
                    raise InvalidFile(Problem("the header", f"has element {name[:40]!r} twice", "each name once"))
                last = elements[name] = Element(name, int(count), [])
            case ["property", "list", counts, kind, name] if last and {counts, kind} <= _TYPES.keys():
                last.properties.append(Property(name, _TYPES[kind], _TYPES[counts]))
            case ["property", kind, name] if last and kind in _TYPES:
                last.properties.append(Property(name, _TYPES[kind]))
            case ["comment" | "obj_info", *words]:
                comments.append(" ".join(words))
            case ["format" | "element" | "property", *_]:
                raise _strange(line)
            case [_, *_]:
                unknown.append(line)
    if not found:
        raise InvalidFile(Problem("the header", "names no format", " or ".join((*ORDERS, TEXT))))
    for element in elements.values():
        names = [each.name for each in element.properties]
        if len(set(names)) < len(names):
            raise InvalidFile(Problem(f"element {element.name[:40]}", "has a property twice", "each name once"))
    return Header([*elements.values()], comments, found, stop + 1, unknown)


def _strange(line: str) -> InvalidFile:
    return InvalidFile(Problem("the header", f"has the line {line.strip()[:60]!r}", _ALLOWED))


class _Binary:
    """The rows of a binary file, one element after the other."""

    def __init__(self, view: memoryview, at: int, order: str) -> None:
        self._view, self._at, self._order = view, at, order

    def table(self, element: Element) -> Table:
        dtype = np.dtype([(each.name, self._order + each.kind) for each in element.properties])
        size = element.rows * dtype.itemsize
        if size > len(self._view) - self._at:
            found = f"declares {element.rows:,} rows of {dtype.itemsize} bytes, with {self._left()} left"
            raise InvalidFile(Problem(f"element {element.name}", found, _ALLOWED))
        table = np.frombuffer(self._view, dtype, element.rows, self._at) if size else np.zeros(0, dtype)
        self._at += size
        return table

    def skip(self, element: Element) -> None:
        if not element.lists:
            self.table(element)
        elif element.rows:
            self._skip_lists(element)

    def _skip_lists(self, element: Element) -> None:
        start = self._at
        fields, size = self._row(element, start)
        dtype = np.dtype(fields)
        if element.rows * size <= len(self._view) - start:
            rows = np.frombuffer(self._view, dtype, element.rows, start)
            lengths = [name for name in dtype.names or () if name.startswith("length")]
            if all((rows[name] == rows[name][0]).all() for name in lengths):  # as in a mesh of triangles
                self._at = start + element.rows * size
                return
        if element.rows > _FEW:
            found = f"has {element.rows:,} rows with lists of different lengths"
            raise InvalidFile(Problem(f"element {element.name}", found, f"{_FEW:,} before the wanted element"))
        for _ in range(element.rows):
            self._at += self._row(element, self._at)[1]

    def _row(self, element: Element, at: int) -> tuple[list[tuple[str, str]], int]:
        """The fields of the row at this offset, and its bytes. Raises InvalidFile."""
        fields, size = [], 0
        for k, each in enumerate(element.properties):
            if each.counts:
                dtype = np.dtype(self._order + each.counts)
                raw = bytes(self._view[at + size : at + size + dtype.itemsize])
                length = int(np.frombuffer(raw, dtype)[0]) if len(raw) == dtype.itemsize and dtype.kind in "iu" else -1
                fields.append((f"length{k}", self._order + each.counts))
                fields.append((f"list{k}", f"V{max(length, 0) * np.dtype(each.kind).itemsize}"))
                size += dtype.itemsize + length * np.dtype(each.kind).itemsize
                if length < 0 or at + size > len(self._view):
                    found = f"has a list of {length:,} entries, with {self._left()} left"
                    raise InvalidFile(Problem(f"element {element.name}", found, _ALLOWED))
            else:
                fields.append((f"number{k}", self._order + each.kind))
                size += np.dtype(each.kind).itemsize
        if at + size > len(self._view):
            raise InvalidFile(Problem(f"element {element.name}", "ends after the file", _ALLOWED))
        return fields, size

    def _left(self) -> str:
        return f"{len(self._view) - self._at:,} bytes"


class _Text:
    """The rows of a file of text, a line each, one element after the other."""

    def __init__(self, view: memoryview, at: int) -> None:
        self._text = np.frombuffer(view, np.uint8)[at:]
        memory.hold("the lines", 2 * len(self._text))
        ends = np.flatnonzero(self._text == ord("\n"))
        if len(self._text) and self._text[-1] != ord("\n"):
            ends = np.append(ends, len(self._text))
        memory.hold("the lines", ends.nbytes)
        self._starts = np.concatenate([[0], ends + 1])
        self._line = 0

    def skip(self, element: Element) -> None:
        left = len(self._starts) - 1 - self._line
        if element.rows > left:
            raise InvalidFile(
                Problem(
                    f"element {element.name}", f"declares {element.rows:,} rows, with {left:,} lines left", _ALLOWED
                )
            )
        self._line += element.rows

    def table(self, element: Element) -> Table:
        first = self._line
        self.skip(element)
        text = self._text[self._starts[first] : self._starts[self._line]]
        count, place = element.rows * len(element.properties), f"element {element.name}"
        if 2 * count - 1 > len(text):
            found = f"declares {element.rows:,} rows of {len(element.properties)} numbers in {len(text):,} bytes"
            raise InvalidFile(Problem(place, found, _ALLOWED))
        memory.hold(place, len(text) + 24 * count)
        with warnings.catch_warnings():
            warnings.simplefilter("error", DeprecationWarning)  # of text that is not numbers
            try:
                numbers = np.fromstring(text.tobytes().decode("latin-1"), np.float64, sep=" ")
            except (DeprecationWarning, ValueError):
                raise InvalidFile(Problem(place, "has text that is not a number", "numbers")) from None
        if len(numbers) != count:
            raise InvalidFile(Problem(place, f"has {len(numbers):,} numbers", f"{count:,}"))
        table = np.empty(element.rows, [(each.name, each.kind) for each in element.properties])
        columns = numbers.reshape(element.rows, len(element.properties)).T
        for each, column in zip(element.properties, columns, strict=True):
            dtype = np.dtype(each.kind)
            if dtype.kind in "iu" and not ((column >= np.iinfo(dtype).min) & (column <= np.iinfo(dtype).max)).all():
                raise InvalidFile(Problem(f"{place}.{each.name[:40]}", "has a number outside its type", dtype.name))
            with np.errstate(over="ignore"):
                table[each.name] = column
        return table
