"""Write a stage as text (.usda). Numbers are the shortest ones that a reader rounds to the same float.

Source: pxr/usd/sdf/usdaFileFormat.cpp and fileIO_Common.cpp of OpenUSD 26.11.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import orjson

from nerfbake.formats.wire.usd.stage import KINDS, METRES_PER_UNIT, Attribute, Prim, Relationship, UsdStage, UsdVariant

MAGIC = b"#usda"
_STEP = 1 << 16  # rows of an array that are written at once


def encode_text(stage: UsdStage) -> Iterator[bytes]:
    """Yield the file in pieces."""
    yield f'{MAGIC.decode()} 1.0\n(\n    defaultPrim = "{stage.root.name}"\n'.encode()
    yield f'    metersPerUnit = {METRES_PER_UNIT:g}\n    upAxis = "{stage.up}"\n)\n'.encode()
    yield from _prim(stage.root, "")


def _prim(prim: Prim, indent: str) -> Iterator[bytes]:
    yield f'\n{indent}def {prim.kind} "{prim.name}"'.encode()
    inner = indent + "    "
    if prim.schemas:
        names = ", ".join(f'"{name}"' for name in prim.schemas)
        yield f" (\n{inner}prepend apiSchemas = [{names}]\n{indent})".encode()
    if prim.variants:
        yield f' (\n{inner}prepend variantSets = "{prim.variant_set}"\n{inner}variants = {{\n'.encode()
        yield f'{inner}    string {prim.variant_set} = "{next(iter(prim.variants))}"\n{inner}}}\n{indent})'.encode()
    yield f"\n{indent}{{\n".encode()
    yield from _body(prim.properties, prim.children, inner)
    if prim.variants:
        yield f'{inner}variantSet "{prim.variant_set}" = {{\n'.encode()
        for name, variant in prim.variants.items():
            yield from _variant(name, variant, inner + "    ")
        yield f"{inner}}}\n".encode()
    yield f"{indent}}}\n".encode()


def _variant(name: str, variant: UsdVariant, indent: str) -> Iterator[bytes]:
    inner = indent + "    "
    yield f'{indent}"{name}" (\n{inner}customData = {{\n{inner}    dictionary nerfbake = {{\n'.encode()
    for key, value in variant.facts.items():
        kind, text = ("string", _quoted(value)) if isinstance(value, str) else ("double", repr(float(value)))
        yield f"{inner}        {kind} {key} = {text}\n".encode()
    yield f"{inner}    }}\n{inner}}}\n".encode()
    if variant.reference:
        yield f"{inner}prepend references = {_path(variant.reference)}\n".encode()
    yield f"{indent}) {{\n".encode()
    yield from _body(variant.properties, variant.children, inner)
    yield f"{indent}}}\n".encode()


def _body(properties: Mapping[str, Attribute | Relationship], children: Sequence[Prim], indent: str) -> Iterator[bytes]:
    for name, each in properties.items():
        if isinstance(each, Relationship):
            targets = ", ".join(f"<{path}>" for path in each.targets)
            yield f"{indent}rel {name} = [{targets}]\n".encode()
        else:
            yield from _attribute(name, each, indent)
    for child in children:
        yield from _prim(child, indent)


def _attribute(name: str, each: Attribute, indent: str) -> Iterator[bytes]:
    start = f"{indent}{'custom ' * each.custom}{'uniform ' * each.uniform}{each.kind} {name}"
    if each.source:
        yield f"{start}.connect = <{each.source}>\n".encode()
        return
    yield start.encode()
    if each.value is not None:
        yield b" = "
        yield from _value(each.kind, each.value)
    if each.more:
        lines = (f"{indent}    {key} = {_quoted(value)}\n" for key, value in each.more.items())
        yield f" (\n{''.join(lines)}{indent})".encode()
    yield b"\n"


def _quoted(value: str | int) -> str:
    """Return a text in quotes, or a number."""
    if isinstance(value, int):
        return str(value)
    plain = value.replace("\\", "\\\\").replace('"', '\\"').replace("\n", "\\n")
    return '"' + "".join(char if char >= " " else f"\\x{ord(char):02x}" for char in plain) + '"'


def _path(path: str) -> str:
    """Return the path of a file, with three marks on each side if there is one in it."""
    return f"@@@{path.replace('@@@', chr(92) + '@@@')}@@@" if "@" in path else f"@{path}@"


def _value(kind: str, value: Any) -> Iterator[bytes]:
    base, array = kind.removesuffix("[]"), kind.endswith("[]")
    _, dtype, columns = KINDS[base]
    if not dtype:
        written = _path if base == "asset" else _quoted
        texts = [written(each) for each in (value if array else [value])]
        yield f"[{', '.join(texts)}]".encode() if array else texts[0].encode()
        return
    numbers = np.asarray(value, dtype).reshape((-1, columns) if columns > 1 else -1)
    if dtype == "<f2":
        numbers = numbers.astype(np.float32)
    if not array:
        yield _matrix(numbers) if base == "matrix4d" else _rows(numbers)
        return
    yield b"["
    for start in range(0, len(numbers), _STEP):
        yield (b", " if start else b"") + _rows(numbers[start : start + _STEP])
    yield b"]"


def _rows(numbers: npt.NDArray[Any]) -> bytes:
    """Return numbers, or tuples of them, with commas between them."""
    text = orjson.dumps(np.ascontiguousarray(numbers), option=orjson.OPT_SERIALIZE_NUMPY)[1:-1]
    text = text.replace(b".0,", b",").replace(b".0]", b"]")
    return text.replace(b"],[", b"), (").replace(b"[", b"(").replace(b"]", b")").removesuffix(b".0")


def _matrix(numbers: npt.NDArray[Any]) -> bytes:
    return b"( " + _rows(numbers.reshape(4, 4)) + b" )"
