r"""Read the header of .ply files, for splats and for meshes.

ply\n format KIND 1.0\n comment ...\n element NAME COUNT\n property TYPE NAME\n property list COUNTS TYPE NAME\n
... end_header\n, then the rows of the first element, of the second, ...
"""

from __future__ import annotations

from typing import NamedTuple

from nerfbake.errors import InvalidFile, Problem

_HEADER = 1 << 16  # bytes
TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4",
    "float": "f4", "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2",
    "int32": "i4", "uint32": "u4", "float32": "f4", "float64": "f8",
}  # fmt: skip
BINARY = {"binary_little_endian": "<", "binary_big_endian": ">"}
_DIGITS = 18  # of a count: it fits in 64 bits


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
        return any(each.counts is not None for each in self.properties)

    @property
    def numbers(self) -> list[tuple[str, str]]:
        """Name and NumPy type of each property that is not a list."""
        return [(each.name, each.kind) for each in self.properties if each.counts is None]


class Header(NamedTuple):
    """The elements, the comments, the kind of the file's numbers, and the offset of the first row."""

    elements: list[Element]
    comments: list[str]
    kind: str
    end: int


def recognise(view: memoryview) -> bool:
    """Return True for the first line of a .ply."""
    return bytes(view[:4]) in (b"ply\n", b"ply\r")


def parse_header(view: memoryview, kinds: tuple[str, ...], allowed: str) -> Header:
    """Parse the header. kinds: the accepted formats; allowed: the accepted files in errors. Raises InvalidFile."""
    head = bytes(view[:_HEADER]).replace(b"\r\n", b" \n")  # of the same length
    end = head.find(b"\nend_header")
    stop = head.find(b"\n", end + 1)
    if not recognise(view) or end < 0 or stop < 0:
        raise InvalidFile(Problem("the header", f"does not end within {_HEADER:,} bytes", allowed))
    elements: list[Element] = []
    comments, found = [], ""
    for line in head[:end].decode("latin-1").split("\n")[1:]:
        match line.split():
            case ["format", kind, _] if kind in kinds:
                found = kind
            case ["element", name, count] if count.isascii() and count.isdigit() and len(count) <= _DIGITS:
                if name in [element.name for element in elements]:
                    raise InvalidFile(Problem("the header", f"has element {name[:40]!r} twice", "each name once"))
                elements.append(Element(name, int(count), []))
            case ["property", "list", counts, kind, name] if elements and counts in TYPES and kind in TYPES:
                elements[-1].properties.append(Property(name, TYPES[kind], TYPES[counts]))
            case ["property", kind, name] if elements and kind in TYPES:
                elements[-1].properties.append(Property(name, TYPES[kind]))
            case ["comment" | "obj_info", *words]:
                comments.append(" ".join(words))
            case [] | [""]:
                pass
            case _:
                raise InvalidFile(Problem("the header", f"has the line {line.strip()[:60]!r}", allowed))
    if not found:
        raise InvalidFile(Problem("the header", "names no format", " or ".join(kinds)))
    for element in elements:
        names = [each.name for each in element.properties]
        if len(set(names)) < len(names):
            raise InvalidFile(Problem(f"element {element.name[:40]}", "has a property twice", "each name once"))
    return Header(elements, comments, found, stop + 1)
