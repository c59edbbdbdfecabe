"""Read untrusted XML with the standard library's expat.

A document type (<!DOCTYPE ...>) is refused before it is read: entities can be declared nowhere else, so none can grow
(a "billion laughs"), and none can name a file or a server. Cameras need none. Depth and size are limited: an element
takes up to a hundred times its bytes in the file, so the elements are counted against the memory limit.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any
from xml.parsers import expat

from nerfbake import memory
from nerfbake.errors import InvalidFile, Problem, one_line

MAX_DEPTH = 64
_ELEMENT = 600  # bytes of memory of an XmlElement with its lists, beside its text
_BATCH = 1024  # elements that are counted at once


class XmlElement:
    """An element: its name and attributes without the prefixes of namespaces, its own text, and its children."""

    __slots__ = ("attributes", "children", "name", "text")

    def __init__(self, name: str, attributes: dict[str, str]) -> None:
        self.name, self.attributes = name, attributes
        self.children: list[XmlElement] = []
        self.text = ""

    def all(self, *path: str) -> Iterator[XmlElement]:
        """Yield the elements at a path of names below this one, in the order of the file."""
        if not path:
            yield self
            return
        for child in self.children:
            if child.name == path[0]:
                yield from child.all(*path[1:])

    def first(self, *path: str) -> XmlElement | None:
        """The first element at a path of names, or None."""
        return next(self.all(*path), None)

    def below(self, name: str) -> Iterator[XmlElement]:
        """Yield this element and all elements inside it that have a name, in the order of the file."""
        waiting = [self]
        while waiting:
            element = waiting.pop()
            if element.name == name:
                yield element
            waiting += reversed(element.children)


def parse_xml(view: memoryview | bytes, name: str) -> XmlElement:
    """Parse a document to its root. name: of the file in messages. Raises InvalidFile, MemoryLimit."""
    memory.hold(f"{name}, parsed,", 4 * len(view))  # the text
    found = _Builder(name)
    parser = expat.ParserCreate()
    parser.buffer_text = True
    parser.StartDoctypeDeclHandler = found.refuse_document_type
    parser.StartElementHandler, parser.EndElementHandler = found.start, found.end
    parser.CharacterDataHandler = found.add_text
    try:
        parser.Parse(bytes(view), True)
    except (expat.ExpatError, ValueError, LookupError) as error:  # also an encoding that Python does not know
        raise InvalidFile(Problem(name, f"is not XML ({one_line(str(error), 80)})", "one whole document")) from None
    assert found.root is not None  # expat refuses a document without an element
    return found.root


class _Builder:
    """Builds the elements, and counts them against the limits."""

    def __init__(self, name: str) -> None:
        self.root: XmlElement | None = None
        self._name, self._open, self._count = name, list[XmlElement](), 0

    def refuse_document_type(self, *_: Any) -> None:
        raise InvalidFile(Problem(self._name, "has a document type (<!DOCTYPE>)", "XML without one"))

    def start(self, name: str, attributes: dict[str, str]) -> None:
        if self._count % _BATCH == 0:
            memory.hold(f"the elements of {self._name}", _BATCH * _ELEMENT)
        self._count += 1
        if len(self._open) == MAX_DEPTH:
            raise InvalidFile(Problem(self._name, f"has elements in more than {MAX_DEPTH} others", "fewer levels"))
        element = XmlElement(_plain(name), {_plain(key): value for key, value in attributes.items()})
        if self._open:
            self._open[-1].children.append(element)
        else:
            self.root = element
        self._open.append(element)

    def end(self, name: str) -> None:
        self._open.pop()

    def add_text(self, text: str) -> None:
        self._open[-1].text += text


def _plain(name: str) -> str:
    return name.rpartition(":")[2]
