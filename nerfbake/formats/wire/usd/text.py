"""Write a stage as text (.usda). Numbers are the shortest ones that a reader rounds to the same float.

Source: pxr/usd/sdf/usdaFileFormat.cpp and fileIO_Common.cpp of OpenUSD 26.11.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import numpy.typing as npt
import orjson

from nerfbake.formats.wire.usd.stage import KINDS, METRES_PER_UNIT, Attribute, Prim, Relationship, UsdStage

MAGIC = b"#usda"
_STEP = 1 << 16  # rows of an array that are written at once


def encode_text(stage: UsdStage) -> Iterator[bytes]:
    """Yield the file in pieces."""
    yield f'{MAGIC.decode()} 1.0\n(\n    defaultPrim = "{stage.root.name}"\n'.encode()
    yield f'    metersPerUnit = {METRES_PER_UNIT:g}\n    upAxis = "{stage.up}"\n)\n'.encode()
    yield from _prim(stage.root, "")


def _prim(prim: Prim, indent: str) -> Iterator[bytes]:
    yield f'\n{indent}def {prim.kind} "{prim.name}"'.encode()
    if prim.schemas:
        names = ", ".join(f'"{name}"' for name in prim.schemas)
        yield f" (\n{indent}    prepend apiSchemas = [{names}]\n{indent})".encode()
    yield f"\n{indent}{{\n".encode()
    inner = indent + "    "
    for name, each in prim.properties.items():
        if isinstance(each, Relationship):
            targets = ", ".join(f"<{path}>" for path in each.targets)
            yield f"{inner}rel {name} = [{targets}]\n".encode()
        else:
            yield from _attribute(name, each, inner)
    for child in prim.children:
        yield from _prim(child, inner)
    yield f"{indent}}}\n".encode()


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
