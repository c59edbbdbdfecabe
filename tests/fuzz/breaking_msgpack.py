"""Break MessagePack: keys, types, sizes, and the arrays of flax in it."""

from __future__ import annotations

from random import Random
from typing import Any

import msgpack

from tests.fuzz import hostile_values as hostile
from tests.fuzz.breaking_bytes import break_bytes, break_words

_DTYPES = ("float32", "float16", "bfloat16", "int8", "bool", "object", "float128", "")


def break_msgpack(random: Random, data: bytes, other: bytes = b"") -> bytes:
    """Remove, rename, replace or break a value, or break the bytes."""
    if random.random() < 0.3:
        return break_bytes(random, data, other)
    root = msgpack.unpackb(data, strict_map_key=False)
    for _ in range(random.choice((1, 1, 2))):
        holder, key = _place(random, root)
        match random.randrange(6):
            case 0:
                del holder[key]
            case 1 if isinstance(holder, dict):
                holder[random.choice((hostile.text(random), "MLP_1", "Dense_1", "Dense_99", "kernel"))] = holder[key]
            case 2:
                holder[key] = _replacement(random)
            case _:
                holder[key] = _broken(random, holder[key])
    return bytes(msgpack.packb(root))


def _place(random: Random, value: Any) -> tuple[Any, Any]:
    """Return a map or list, and the key of a value in it, more often a deep one."""
    while True:
        key = random.choice([*value]) if isinstance(value, dict) else random.randrange(len(value))
        inner = value[key]
        if not isinstance(inner, dict | list) or not inner or random.random() < 0.1:
            return value, key
        value = inner


def _replacement(random: Random) -> Any:
    deep: Any = []
    for _ in range(random.choice((3, 70))):
        deep = [deep]
    whole = max(-(1 << 63), min(hostile.whole(random), (1 << 64) - 1))
    kinds: tuple[Any, ...] = (
        None,
        True,
        1.5,
        float("nan"),
        b"",
        {},
        hostile.text(random),
        whole,
        deep,
        msgpack.ExtType(5, b"x"),
    )
    return random.choice(kinds)


def _broken(random: Random, value: Any) -> Any:
    if isinstance(value, bytes):
        return break_words(random, value)
    if not isinstance(value, msgpack.ExtType):
        return _replacement(random)
    if random.random() < 0.1:
        return msgpack.ExtType(random.choice((0, 2, 3, 127)), value.data)
    shape, dtype, data = msgpack.unpackb(value.data)
    match random.randrange(5):
        case 0:
            shape = [*shape[:-1], max(-9, min(hostile.whole(random), 1 << 62))]
        case 1:
            shape = random.choice(([], shape[::-1], [*shape, 1], [1 << 40] * 3, [0, *shape], None))
        case 2:
            dtype = random.choice(_DTYPES)
        case 3:
            data = data[: random.randrange(len(data) + 1)]
        case _:
            data = break_words(random, data)
    return msgpack.ExtType(value.code, msgpack.packb([shape, dtype, data]))
