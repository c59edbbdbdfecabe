r"""Write a stage as a crate, version 0.8.0 (.usdc).

    0        8          16      24      88
    "PXR-USDC"|0 8 0 ... |i64 toc|i64 x 8| values | six sections | toc: u64 sections, (name 16, i64 start, i64 size)

    TOKENS     u64 count | u64 size | packed: every text once, each ends with \0
    STRINGS    u64 count | u32 index of a token each
    FIELDS     u64 count | numbers: token of the field's name | packed: u64 value each
    FIELDSETS  u64 count | numbers: fields of a spec, each set ends with 2^32 - 1
    PATHS      u64 count | u64 count | numbers: index, token (negative: a property), jump
    SPECS      u64 count | numbers: path, field set, type (1 attribute, 6 prim, 7 the stage, 8 relationship)

numbers = u64 size | packed; packed = u64 size, if not told above | 0 | a block of LZ4, here one run of literals.
A value: 63 array | 62 inlined | 61 packed numbers | ... | 55 type | 47 offset in the file, or an inlined value | 0
An array: u64 count | the values. Whole numbers may be packed as `numbers` are, if there are 16 or more:

    i32 most frequent difference | 2 bits a number: 0 that difference, 1 a byte, 2 two bytes, 3 four | the differences

Sections are small but for values, so that nothing is compressed; programs of every version read such blocks.
Source: pxr/usd/sdf/crateFile.cpp and pxr/usd/sdf/integerCoding.cpp of OpenUSD 26.11.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from nerfbake.formats.wire.usd.stage import KINDS, METRES_PER_UNIT, Attribute, Prim, Relationship, UsdStage

MAGIC = b"PXR-USDC"
_VERSION = (0, 8, 0)
_ARRAY, _INLINED, _PACKED = 1 << 63, 1 << 62, 1 << 61
_INT, _DOUBLE, _TOKEN, _TOKEN_LIST, _PATH_LIST, _TOKENS, _SPECIFIER, _VARIABILITY = 3, 9, 11, 32, 34, 41, 42, 44
_BOOL, _FLOAT = 1, 8
_ATTRIBUTE, _PRIM, _STAGE, _RELATIONSHIP = 1, 6, 7, 8
_END = 0xFFFFFFFF  # of a field set
_EXPLICIT, _PREPENDED = 1 | 2, 32  # of a list operation
_LEAST_PACKED = 16  # numbers of an array that is packed
_ALIGNED = 16  # bytes: where arrays start, so that a mapped file can be used as it is
_HEADER = 88


def encode_crate(stage: UsdStage) -> Iterator[bytes | memoryview]:
    """Yield the file in pieces."""
    crate = _Crate()
    crate.add_stage(stage)
    yield from crate.pieces()


class _Crate:
    """The values and tables of a file."""

    def __init__(self) -> None:
        self._values: list[bytes | memoryview] = []
        self._size = _HEADER
        self._tokens: dict[str, int] = {";-)": 0}  # a property's token is negated, so that it cannot be number 0
        self._strings: dict[str, int] = {}
        self._fields: dict[tuple[int, int], int] = {}
        self._sets: list[list[int]] = []
        self._paths: list[tuple[int, int, int]] = []  # token (negative for a property), depth, index
        self._indices: dict[str, int] = {}
        self._specs: list[tuple[int, int, int]] = []

    def add_stage(self, stage: UsdStage) -> None:
        self._number_paths("/", 0, 0)
        self._number_prim(stage.root, "/", 1)
        fields = [
            ("defaultPrim", self._token(stage.root.name)),
            ("metersPerUnit", _double(METRES_PER_UNIT)),
            ("upAxis", self._token(stage.up)),
            ("primChildren", self._names([stage.root.name])),
        ]
        self._add_spec("/", _STAGE, fields)
        self._add_prim(stage.root, "/")

    def _number_prim(self, prim: Prim, above: str, depth: int) -> None:
        """Number a prim's path and those below it, in the order in which they are written."""
        path = f"{above}{prim.name}"
        self._number_paths(path, self._index(prim.name), depth)
        for child in prim.children:
            self._number_prim(child, f"{path}/", depth + 1)
        for name in prim.properties:
            self._number_paths(f"{path}.{name}", -self._index(name), depth + 1)

    def _number_paths(self, path: str, token: int, depth: int) -> None:
        self._indices[path] = len(self._paths)
        self._paths.append((token, depth, len(self._paths)))

    def _add_prim(self, prim: Prim, above: str) -> None:
        path = f"{above}{prim.name}"
        fields = [("specifier", _inlined(_SPECIFIER, 0)), ("typeName", self._token(prim.kind))]
        if prim.schemas:
            fields.append(("apiSchemas", self._list(_TOKEN_LIST, _PREPENDED, [self._index(s) for s in prim.schemas])))
        if prim.children:
            fields.append(("primChildren", self._names([child.name for child in prim.children])))
        if prim.properties:
            fields.append(("properties", self._names(list(prim.properties))))
        self._add_spec(path, _PRIM, fields)
        for child in prim.children:
            self._add_prim(child, f"{path}/")
        for name, each in prim.properties.items():
            if isinstance(each, Attribute):
                self._add_spec(f"{path}.{name}", _ATTRIBUTE, self._attribute(each))
            else:
                self._add_spec(f"{path}.{name}", _RELATIONSHIP, self._relationship(each))

    def _attribute(self, each: Attribute) -> list[tuple[str, int]]:
        fields = [
            ("custom", _inlined(_BOOL, int(each.custom))),
            ("typeName", self._token(each.kind)),
            ("variability", _inlined(_VARIABILITY, int(each.uniform))),
        ]
        if each.value is not None:
            fields.append(("default", self._value(each.kind, each.value)))
        for name, value in each.more.items():
            fields.append((name, self._token(value) if isinstance(value, str) else _inlined(_INT, value)))
        if each.source:
            fields.append(("connectionPaths", self._list(_PATH_LIST, _EXPLICIT, [self._indices[each.source]])))
        return fields

    def _relationship(self, each: Relationship) -> list[tuple[str, int]]:
        targets = [self._indices[path] for path in each.targets]
        return [
            ("custom", _inlined(_BOOL, 0)),
            ("variability", _inlined(_VARIABILITY, 1)),
            ("targetPaths", self._list(_PATH_LIST, _EXPLICIT, targets)),
        ]

    # -- values ------------------------------------------------------------------------------------------------
    def _value(self, kind: str, value: Any) -> int:
        base, array = kind.removesuffix("[]"), kind.endswith("[]")
        code, dtype, columns = KINDS[base]
        if not dtype:
            index = self._string if base == "string" else self._index
            indices = [index(each) for each in (value if array else [value])]
            return self._array(code, np.array(indices, "<u4")) if array else _inlined(code, indices[0])
        numbers = np.ascontiguousarray(value, dtype)
        if base.startswith("quat"):
            numbers = np.ascontiguousarray(numbers.reshape(-1, 4)[:, [1, 2, 3, 0]])
        if array:
            return self._array(code, numbers.reshape((-1, columns) if columns > 1 else -1))
        if columns == 1 and dtype != "<f8":
            return _inlined(code, int.from_bytes(numbers.tobytes(), "little"))
        return code << 48 | self._append(numbers.tobytes())

    def _array(self, code: int, numbers: npt.NDArray[Any]) -> int:
        if not numbers.size:
            return _ARRAY | code << 48
        head = struct.pack("<Q", len(numbers))
        if code == _INT and len(numbers) >= _LEAST_PACKED:
            return _ARRAY | _PACKED | code << 48 | self._append(head + _packed_numbers(numbers))
        return _ARRAY | code << 48 | self._append(head, numbers.reshape(-1).view(np.uint8).data)

    def _list(self, code: int, kind: int, items: Sequence[int]) -> int:
        return code << 48 | self._append(struct.pack(f"<BQ{len(items)}I", kind, len(items), *items))

    def _names(self, names: Sequence[str]) -> int:
        indices = [self._index(name) for name in names]
        return _TOKENS << 48 | self._append(struct.pack(f"<Q{len(indices)}I", len(indices), *indices))

    def _append(self, *pieces: bytes | memoryview) -> int:
        """Add bytes to the values and return their offset. What follows the first piece of several is aligned."""
        gap = -(self._size + len(pieces[0])) % _ALIGNED if len(pieces) > 1 else -self._size % 8
        self._values += [bytes(gap), *pieces]
        at = self._size + gap
        self._size = at + sum(map(len, pieces))
        return at

    def _token(self, text: str) -> int:
        return _inlined(_TOKEN, self._index(text))

    def _index(self, text: str) -> int:
        return self._tokens.setdefault(text, len(self._tokens))

    def _string(self, text: str) -> int:
        self._index(text)
        return self._strings.setdefault(text, len(self._strings))

    # -- tables ------------------------------------------------------------------------------------------------
    def _add_spec(self, path: str, kind: int, fields: Sequence[tuple[str, int]]) -> None:
        found = [self._fields.setdefault((self._index(name), rep), len(self._fields)) for name, rep in fields]
        if found not in self._sets:
            self._sets.append(found)
        start = sum(len(each) + 1 for each in self._sets[: self._sets.index(found)])
        self._specs.append((self._indices[path], start, kind))

    def pieces(self) -> Iterator[bytes | memoryview]:
        """Yield the file: the header, the values and the sections."""
        sections = [
            (b"TOKENS", self._tokens_section()),
            (b"STRINGS", self._strings_section()),
            (b"FIELDS", self._fields_section()),
            (b"FIELDSETS", self._sets_section()),
            (b"PATHS", self._paths_section()),
            (b"SPECS", struct.pack("<Q", len(self._specs)) + b"".join(map(_packed_numbers, _columns(self._specs)))),
        ]
        toc, at = [], self._size
        for name, section in sections:
            toc.append(struct.pack("<16sqq", name, at, len(section)))
            at += len(section)
        yield struct.pack("<8s8Bq64x", MAGIC, *_VERSION, 0, 0, 0, 0, 0, at)
        yield from self._values
        yield from (section for _, section in sections)
        yield struct.pack("<Q", len(toc)) + b"".join(toc)

    def _tokens_section(self) -> bytes:
        text = b"".join(token.encode() + b"\0" for token in self._tokens)
        packed = _packed(text)
        return struct.pack("<QQQ", len(self._tokens), len(text), len(packed)) + packed

    def _strings_section(self) -> bytes:
        indices = [self._tokens[text] for text in self._strings]
        return struct.pack(f"<Q{len(indices)}I", len(indices), *indices)

    def _fields_section(self) -> bytes:
        names, values = zip(*self._fields, strict=True)
        packed = _packed(np.array(values, "<u8").tobytes())
        head = struct.pack("<Q", len(names)) + _packed_numbers(np.array(names))
        return head + struct.pack("<Q", len(packed)) + packed

    def _sets_section(self) -> bytes:
        numbers = [index for each in self._sets for index in (*each, _END)]
        return struct.pack("<Q", len(numbers)) + _packed_numbers(np.array(numbers))

    def _paths_section(self) -> bytes:
        """The paths in the order of a tree. jump: -2 neither child nor sibling, -1 child, 0 sibling, n both."""
        depths = [depth for _, depth, _ in self._paths]
        jumps = []
        for i, depth in enumerate(depths):
            after = next((k for k in range(i + 1, len(depths)) if depths[k] <= depth), len(depths))
            sibling, child = after < len(depths) and depths[after] == depth, after > i + 1
            jumps.append((after - i if child else 0) if sibling else -1 if child else -2)
        tokens, _, indices = _columns(self._paths)
        counts = struct.pack("<QQ", len(self._paths), len(self._paths))
        return counts + b"".join(map(_packed_numbers, (indices, tokens, np.array(jumps))))


def _columns(rows: Sequence[tuple[int, int, int]]) -> list[npt.NDArray[np.int64]]:
    return list(np.array(rows, np.int64).T)


def _inlined(code: int, value: int) -> int:
    return _INLINED | code << 48 | value & 0xFFFFFFFF


def _double(value: float) -> int:
    """A double that is a float, inlined as one."""
    return _inlined(_DOUBLE, int.from_bytes(struct.pack("<f", value), "little"))


def _packed_numbers(numbers: npt.NDArray[Any]) -> bytes:
    """Return whole numbers of 32 bits as their differences, packed, with the size before them."""
    found = np.diff(numbers.astype(np.int64), prepend=0).astype(np.uint32).astype(np.int32)  # modulo 2^32
    values, counts = np.unique(found, return_counts=True)
    common = values[len(counts) - 1 - np.argmax(counts[::-1])]  # of equally frequent ones the largest
    wide = found.astype(np.int64)
    codes = np.select([found == common, np.abs(wide + 0.5) < 1 << 7, np.abs(wide + 0.5) < 1 << 15], [0, 1, 2], 3)
    four = np.concatenate([codes, np.zeros(-len(codes) % 4, codes.dtype)]).reshape(-1, 4).astype(np.uint8)
    sizes = np.array([0, 1, 2, 4])[codes]
    held = np.arange(4) < sizes[:, None]
    body = found.astype("<i4").view(np.uint8).reshape(-1, 4)[held]
    bits = (four << np.array([0, 2, 4, 6], np.uint8)).sum(axis=1).astype(np.uint8)
    packed = _packed(struct.pack("<i", int(common)) + bits.tobytes() + body.tobytes())
    return struct.pack("<Q", len(packed)) + packed


def _packed(data: bytes) -> bytes:
    """Return a block of LZ4 in one chunk that consists of literals."""
    rest = len(data) - 15
    if rest < 0:
        return bytes([0, len(data) << 4]) + data
    return bytes([0, 0xF0]) + b"\xff" * (rest // 255) + bytes([rest % 255]) + data
