"""Read YAML as plain values, and run nothing: nerfstudio's config.yml, and the configurations of other programs.

    !!python/object:nerfstudio.engine.trainer.TrainerConfig     {
    _target: &id001 !!python/name:torch.optim.adam.Adam ''        "_target": "",
    other: *id001                                                 "other": "",        the same object
    output_dir: !!python/object/apply:pathlib.PosixPath           "output_dir": ["/", "data"],
    - /
    - data
    eps: 1.0e-15                                                  "eps": 1e-15,
    max_norm: null                                                "max_norm": None,
    load_3D_points: false                                         "load_3D_points": False}

Tags are ignored: a map with a tag is a dict, a sequence with a tag is a list, and a scalar with a tag is its text. Only
a plain scalar without a tag can be a number, a bool or null, by the rules of YAML 1.1 as PyYAML applies them: 1e-3 is
text, because a float needs a point, and `on` is true. Dates remain text.

PyYAML's parser splits the text into events. It runs nothing, and does not recurse. PyYAML's composers and constructors,
which call what a file names, are not used. An alias is the same object as its anchor; everything that a walk through
the values would meet is counted, so that aliases of aliases cannot make a small file large.

Source: YAML 1.1; PyYAML's lib/yaml/resolver.py and constructor.py.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import yaml

from nerfbake import memory
from nerfbake.errors import InvalidFile, Problem
from nerfbake.formats.wire.json import shorten

MAX_BYTES = 1 << 16  # nerfstudio's files have 7,000 to 10,000; PyYAML takes about 1 s for this many at most
MAX_SIZE = 1 << 20  # values and characters, each as often as aliases repeat it
MAX_DEPTH = 64  # lists and maps within each other
_LONGEST_NUMBER = 100  # characters
_PER_BYTE = 160  # bytes of memory for a byte of text: [?,?] contains a map per two bytes

_PREFIX = "tag:yaml.org,2002:"
_RESOLVER = yaml.resolver.Resolver()
_CONSTRUCTOR = yaml.constructor.SafeConstructor()
_SCALARS: dict[str, Callable[[yaml.ScalarNode], Any]] = {
    f"{_PREFIX}null": _CONSTRUCTOR.construct_yaml_null,
    f"{_PREFIX}bool": _CONSTRUCTOR.construct_yaml_bool,
    f"{_PREFIX}int": _CONSTRUCTOR.construct_yaml_int,
    f"{_PREFIX}float": _CONSTRUCTOR.construct_yaml_float,
}


def parse_map(view: memoryview, name: str) -> dict[Any, Any]:
    """Parse a file with one document, a map, to dict, list, str, int, float, bool and None.

    A key is text, or another scalar. Values may be shared: do not change them. name: the file's name in errors, which
    add the line. Raises InvalidFile, MemoryLimit.
    """
    if len(view) > MAX_BYTES:
        raise InvalidFile(Problem(name, f"has {len(view):,} bytes", f"{MAX_BYTES:,} at most"))
    memory.hold(f"{name}, parsed,", _PER_BYTE * len(view))
    try:
        text = str(view, "utf-8-sig")
    except UnicodeDecodeError:
        raise InvalidFile(Problem(name, "is not UTF-8", "UTF-8")) from None
    value = _Builder(name).build(text)
    if not isinstance(value, dict):
        raise InvalidFile(Problem(name, "does not contain a map", "one map"))
    return value


class _Part(NamedTuple):
    """A value, its size in values and characters, and the number of lists and maps inside each other in it."""

    value: Any
    size: int
    depth: int


class _Open:
    """A list or a map whose end has not been read. key: of the value that follows in a map."""

    def __init__(self, value: Any, anchor: str | None) -> None:
        self.value, self.anchor = value, anchor
        self.size, self.depth = 1, 1
        self.has_key, self.key = False, None


class _Builder:
    def __init__(self, name: str) -> None:
        self._name, self._line = name, 1
        self._open: list[_Open] = []
        self._anchors: dict[str, _Part | None] = {}  # None: a list or a map that is still open
        self._size = 0
        self._root: Any = None

    def build(self, text: str) -> Any:
        """Return the only document's value."""
        documents = 0
        for event in self._events(text):
            self._line = event.start_mark.line + 1
            match event:
                case yaml.DocumentStartEvent():
                    documents += 1
                    if documents > 1:
                        raise self._refusal("has a second document", "one document")
                case yaml.MappingStartEvent() | yaml.SequenceStartEvent():
                    self._begin({} if isinstance(event, yaml.MappingStartEvent) else [], event.anchor)
                case yaml.MappingEndEvent() | yaml.SequenceEndEvent():
                    done = self._open.pop()
                    self._add(_Part(done.value, done.size, done.depth), done.anchor)
                case yaml.ScalarEvent():
                    self._count(1 + len(event.value))
                    self._add(_Part(self._scalar(event), 1 + len(event.value), 0), event.anchor)
                case yaml.AliasEvent():
                    self._alias(event.anchor)
        return self._root

    def _events(self, text: str) -> Iterator[Any]:
        try:
            yield from yaml.parse(text, yaml.SafeLoader)
        except yaml.MarkedYAMLError as error:
            mark = error.problem_mark or error.context_mark
            self._line = mark.line + 1 if mark else self._line
            raise self._refusal(f"cannot be parsed ({error.problem})", "YAML 1.1") from None
        except yaml.YAMLError as error:
            raise self._refusal(f"cannot be parsed ({str(error).partition(chr(10))[0]})", "YAML 1.1") from None
        except (ValueError, ArithmeticError, LookupError):  # PyYAML's, for an invalid escape or version
            raise self._refusal("cannot be parsed", "YAML 1.1") from None

    def _refusal(self, found: str, allowed: str) -> InvalidFile:
        return InvalidFile(Problem(f"{self._name} at line {self._line:,}", found, allowed))

    # -- values ------------------------------------------------------------------------------------------------
    def _begin(self, value: Any, anchor: str | None) -> None:
        self._count(1)
        self._open.append(_Open(value, anchor))
        self._check_depth(0)
        if anchor is not None:
            self._anchors[anchor] = None

    def _alias(self, anchor: str) -> None:
        if anchor not in self._anchors:
            raise self._refusal(f"refers to the anchor {anchor:.40}, which is missing", "an anchor before it")
        if (part := self._anchors[anchor]) is None:
            raise self._refusal(f"refers to the anchor {anchor:.40} inside of its own value", "no cycle")
        self._count(part.size)
        self._check_depth(part.depth)
        self._add(part, None)

    def _count(self, size: int) -> None:
        self._size += size
        if self._size > MAX_SIZE:
            found = f"has {self._size:,} values and characters or more, with aliases resolved"
            raise self._refusal(found, f"{MAX_SIZE:,} at most")

    def _check_depth(self, inside: int) -> None:
        if len(self._open) + inside > MAX_DEPTH:
            raise self._refusal(f"has more than {MAX_DEPTH} lists and maps inside each other", f"{MAX_DEPTH} at most")

    def _add(self, part: _Part, anchor: str | None) -> None:
        """Put a value where it belongs: into the innermost open list or map, or at the root."""
        if anchor is not None:
            self._anchors[anchor] = part
        if not self._open:
            self._root = part.value
            return
        target = self._open[-1]
        target.size += part.size
        target.depth = max(target.depth, part.depth + 1)
        if isinstance(target.value, list):
            target.value.append(part.value)
        elif target.has_key:
            target.value[target.key] = part.value
            target.has_key = False
        else:
            if isinstance(part.value, list | dict):
                raise self._refusal("has a key that is a list or a map", "text")
            if part.value in target.value:
                raise self._refusal(f"has the key {shorten(part.value)} twice in a map", "each key once")
            target.has_key, target.key = True, part.value

    def _scalar(self, event: yaml.ScalarEvent) -> Any:
        """Return a plain scalar without a tag as a number, a bool or None if it is one, and else the text."""
        text: str = event.value
        try:
            text.encode()
        except UnicodeEncodeError:
            raise self._refusal("has text that is not Unicode", "Unicode") from None
        if event.tag is not None or not event.implicit[0]:
            return text
        tag = _RESOLVER.resolve(yaml.ScalarNode, text, (True, False))
        if tag == f"{_PREFIX}merge":
            raise self._refusal("has a merge key (<<)", "each map with all its keys")
        if tag not in _SCALARS:
            return text
        if len(text) > _LONGEST_NUMBER:
            raise self._refusal(f"has a number of {len(text):,} characters", f"{_LONGEST_NUMBER} at most")
        try:
            return _SCALARS[tag](yaml.ScalarNode(tag, text))
        except ValueError:  # PyYAML's rule for numbers also matches 0x_
            raise self._refusal(f"has the number {text!r}, which has no digits", "a number") from None
