"""Break Protocol Buffers, BSON, Cap'n Proto and FlatBuffers: tags, lengths, types, pointers."""

from __future__ import annotations

import struct
from random import Random

from tests.fuzz import hostile_values as hostile
from tests.fuzz.breaking_bytes import break_bytes, break_words


def _varint(value: int) -> bytes:
    out, value = bytearray(), value & (1 << 64) - 1
    while value > 127:
        out.append(value & 127 | 128)
        value >>= 7
    return bytes([*out, value])


def _read_varint(data: bytes, at: int) -> tuple[int, int]:
    value = shift = 0
    while True:
        byte = data[at]
        value |= (byte & 127) << shift
        at, shift = at + 1, shift + 7
        if byte < 128:
            return value, at


def break_protobuf(random: Random, data: bytes, other: bytes = b"") -> bytes:
    """Remove, repeat or renumber fields of a message, or change their wire types or values."""
    fields, taken = _fields(data), _fields(other)
    for _ in range(random.choice((1, 1, 2, 3))):
        at = random.randrange(len(fields)) if fields else 0
        number, wire, value = fields[at] if fields else (1, 2, b"")
        match random.randrange(10):
            case 0:
                del fields[at : at + 1]
            case 1:
                fields[at:at] = [(number, wire, value)] * random.choice((1, 2, 20_000))
            case 2:
                fields[at : at + 1] = [
                    (random.choice((0, 1, 5, 6, 13, 14, hostile.whole(random, signed=False))), wire, value)
                ]
            case 3:
                fields[at : at + 1] = [(number, random.randrange(8), value)]
            case 4 if taken:
                fields.insert(at, random.choice(taken))
            case 5:
                random.shuffle(fields)
            case _ if wire == 0:
                fields[at : at + 1] = [(number, 0, _varint(hostile.whole(random)))]
            case 6 | 7:
                piece = value[: random.randrange(len(value) + 1)] if random.random() < 0.3 else value
                fields[at : at + 1] = [(number, wire, break_words(random, piece, other))]
            case 8:
                fields[at : at + 1] = [(number, wire, hostile.text(random).encode())]
            case _:
                fields[at : at + 1] = [(number, wire, break_bytes(random, value, other))]
    return b"".join(_field(random, *field) for field in fields)


def _fields(data: bytes) -> list[tuple[int, int, bytes]]:
    found, at = [], 0
    while at < len(data):
        tag, at = _read_varint(data, at)
        start, wire = at, tag & 7
        if wire == 0:
            _, at = _read_varint(data, at)
        elif wire == 2:
            size, start = _read_varint(data, at)
            at = start + size
        else:
            at += {1: 8, 5: 4}[wire] if wire in (1, 5) else len(data)
        found.append((tag >> 3, wire, data[start:at]))
    return found


def _field(random: Random, number: int, wire: int, value: bytes) -> bytes:
    tag = _varint(number << 3 | wire)
    if wire != 2:
        return tag + value
    size = len(value) if random.random() < 0.97 else hostile.whole(random, signed=False)
    return tag + _varint(size) + value


_Element = tuple[int, bytes, bytes]  # type, name, the value's bytes
_BSON_FIXED = {1: 8, 7: 12, 8: 1, 9: 8, 10: 0, 16: 4, 17: 8, 18: 8, 19: 16}


def break_bson(random: Random, data: bytes, other: bytes = b"") -> bytes:
    """Remove, repeat or rename elements of a document, or change their types or values."""
    elements = _elements(data)
    at = random.randrange(len(elements)) if elements else 0
    kind, name, value = elements[at] if elements else (16, b"0", bytes(4))
    match random.randrange(10):
        case 0:
            del elements[at : at + 1]
        case 1:
            elements[at:at] = [(kind, name, value)] * random.choice((1, 2, 2000))
        case 2:
            elements[at : at + 1] = [(random.choice((0, 1, 2, 3, 4, 5, 8, 10, 16, 18, 19, 255)), name, value)]
        case 3:
            elements[at : at + 1] = [
                (kind, random.choice((b"", b"0", b"data", b"\xff", name + b"x", b"x" * 90)), value)
            ]
        case 4:
            text = hostile.text(random).encode("utf-8", "replace") + b"\0"
            elements[at : at + 1] = [(2, name, struct.pack("<i", len(text)) + text)]
        case 5:
            elements[at : at + 1] = [(18, name, hostile.word(random, 8)), (1, name, hostile.word(random, 8))][:1]
        case 6:
            elements[at : at + 1] = [(1, name, hostile.word(random, 8))]
        case _ if kind in (3, 4) and random.random() < 0.8:
            elements[at : at + 1] = [(kind, name, break_bson(random, value))]
        case _:
            elements[at : at + 1] = [(kind, name, break_words(random, value))]
    body = b"".join(bytes([kind]) + name + b"\0" + value for kind, name, value in elements)
    size = 4 + len(body) + 1 if random.random() < 0.97 else hostile.whole(random) & 0xFFFFFFFF
    return struct.pack("<I", size & 0xFFFFFFFF) + body + b"\0"


def _elements(data: bytes) -> list[_Element]:
    found, at = [], 4
    while at < len(data) - 1:
        kind, end = data[at], data.index(b"\0", at + 1)
        name, at = data[at + 1 : end], end + 1
        if kind in _BSON_FIXED:
            size = _BSON_FIXED[kind]
        else:
            size = struct.unpack_from("<i", data, at)[0] + {2: 4, 3: 0, 4: 0, 5: 5}[kind]
        found.append((kind, name, data[at : at + size]))
        at += size
    return found


def break_flatbuffers(random: Random, data: bytes, other: bytes = b"") -> bytes:
    """Change numbers: offsets, vtables and lengths. Sometimes break bytes: identifier and text."""
    if random.random() < 0.1:
        return break_bytes(random, data, other)
    for _ in range(random.choice((1, 1, 2, 4))):
        data = break_words(random, data, other, widths=(2, 4, 4, 4, 8))
    return data


def break_capnp(random: Random, data: bytes, other: bytes = b"") -> bytes:
    """Change the type, target or size of pointers, or the boundaries of segments."""
    if random.random() < 0.1:
        return break_bytes(random, data, other)
    broken = bytearray(data)
    for _ in range(random.choice((1, 1, 2, 4))):
        words = len(broken) // 8
        at = 8 * int(words * random.random() ** 3)
        match random.randrange(4):
            case 0:
                low = (random.randint(-40, 40) << 2 | random.randrange(4)) & 0xFFFFFFFF
                broken[at : at + 4] = low.to_bytes(4, "little")
            case 1:
                high = random.choice((hostile.whole(random), random.randrange(64) << 3 | random.randrange(8)))
                broken[at + 4 : at + 8] = (high & 0xFFFFFFFF).to_bytes(4, "little")
            case 2:
                cut = random.randrange(words)
                heads = struct.pack("<4I", 1, cut, max(words - 1 - cut, 0), 0)
                broken = bytearray(heads + broken[8:])
            case _:
                broken = bytearray(break_words(random, bytes(broken), other, widths=(4, 8)))
    return bytes(broken)
