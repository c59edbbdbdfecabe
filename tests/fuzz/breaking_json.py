"""Break JSON: change its values or its syntax."""

from __future__ import annotations

import json
from random import Random
from typing import Any

from tests.fuzz import hostile_values as hostile
from tests.fuzz.breaking_bytes import break_bytes


class Pairs(list[tuple[str, Any]]):
    """An object that may contain a key twice."""


class Raw(str):
    """Text that is written to the file unchanged."""


def parse(data: bytes) -> Any:
    return json.loads(data, object_pairs_hook=Pairs)


def spell(value: Any) -> str:
    match value:
        case Raw():
            return str(value)
        case Pairs():
            return "{" + ",".join(f"{spell(key)}:{spell(part)}" for key, part in value) + "}"
        case list():
            return "[" + ",".join(map(spell, value)) + "]"
        case _:
            return json.dumps(value)


def break_json(random: Random, data: bytes, other: bytes = b"") -> bytes:
    """Change one to three values, keys or lists of the file; sometimes break it as text."""
    if random.random() < 0.1:
        return break_bytes(random, data, other)
    tree = parse(data)
    for _ in range(random.choice((1, 1, 1, 2, 3))):
        tree = break_tree(random, tree)
    return spell(tree).encode("utf-8", "surrogatepass")


def break_json_lines(random: Random, data: bytes, other: bytes = b"") -> bytes:
    """Break, remove or repeat a line."""
    lines = data.split(b"\n")
    at = random.randrange(len(lines))
    match random.randrange(8):
        case 0:
            del lines[at]
        case 1:
            lines.insert(at, random.choice((lines[at], *other.split(b"\n"))))
        case _:
            lines[at] = break_json(random, lines[at], other)
    return b"\n".join(lines)


def break_tree(random: Random, tree: Any) -> Any:
    """Change one random place in a tree of values."""
    holder, at, value = None, 0, tree
    while isinstance(value, list) and value and random.random() < 0.8:
        holder, at = value, random.randrange(len(value))
        value = holder[at][1] if isinstance(holder, Pairs) else holder[at]
    if holder is None:
        return _instead(random, tree)
    key = holder[at][0] if isinstance(holder, Pairs) else None
    match random.randrange(8):
        case 0:
            del holder[at]
        case 1:
            holder.insert(random.randrange(len(holder) + 1), holder[at])
        case 2:
            holder[at:at] = [holder[at]] * _few(random.choice((1, 10, 1000)), value)
        case 3 if key is not None:
            holder[at] = (random.choice((hostile.text(random), random.choice(holder)[0])), value)
        case _:
            holder[at] = _instead(random, value) if key is None else (key, _instead(random, value))
    return tree


def _instead(random: Random, value: Any) -> Any:
    """A replacement for a value, of the same or another type."""
    if isinstance(value, bool | int | float) and random.random() < 0.6:
        return Raw(_number(random, value))
    match random.randrange(12):
        case 0:
            return None
        case 1:
            return random.choice((True, False))
        case 2:
            return Raw(json.dumps(hostile.text(random)))
        case 3:
            return Raw(random.choice(('"\\ud800"', '"\\u0000"', '"\\ud83d\\ude00"', '"\x7f"', '"\udc80"', '"\\x"')))
        case 4:
            return []
        case 5:
            return Pairs()
        case 6:
            return [value] * _few(random.choice((1, 3, 100)), value)
        case 7:
            depth = random.choice((10, 200, 1024, 5000, 100_000))
            return Raw("[" * depth + "]" * depth)
        case 8:
            return Raw("[" + "[]," * random.choice((1000, 100_000)) + "[]]")
        case 9:
            return Pairs([("a", value)])
        case _:
            return Raw(_number(random, 0))


def _few(count: int, value: Any) -> int:
    """Limit a number of copies of a value to one megabyte: copies of copies would make files of gigabytes."""
    return min(count, 1 + (1 << 20) // len(spell(value)))


def _number(random: Random, value: float) -> str:
    match random.randrange(10):
        case 0:
            return "9" * random.choice((20, 400, 5000))
        case 1:
            return random.choice(("1e999", "-1e999", "1e400", "0.1e-999", "1E+308", "1e-400"))
        case 2:
            return random.choice(("NaN", "Infinity", "-Infinity", "nan", "0x10", "01", "1.", "+1", "-"))
        case 3 | 4:
            return str(hostile.whole(random))
        case 5 | 6:
            return repr(hostile.real(random))
        case 7:
            return repr(-value)
        case _:
            return repr(value * random.choice((1.5, 1e3, 1e10, 1e30, 1e-30, 0)))
