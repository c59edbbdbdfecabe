"""Break .svoq, PNG, .glb, .obj, .ply and VDB files."""

from __future__ import annotations

import struct
import zlib
from random import Random
from typing import Any

from tests.fuzz import hostile_values as hostile
from tests.fuzz.breaking_bytes import break_bytes, break_words
from tests.fuzz.breaking_json import Pairs, Raw, break_tree, parse, spell

_PNG = b"\x89PNG\r\n\x1a\n"


def break_svoq(random: Random, data: bytes, other: bytes = b"") -> bytes:
    """Change the bytes or the header of a compressed octree, mostly with a matching checksum."""
    head = 152
    if random.random() < 0.5:
        data = break_words(random, data[:head], other[:head], widths=(1, 2, 4)) + data[head:]
    else:
        data = break_bytes(random, data, other)
    return data if random.random() < 0.1 else data[:-4] + zlib.crc32(data[:-4]).to_bytes(4, "little")


def break_png(random: Random, data: bytes, other: bytes = b"") -> bytes:
    """Change, remove, repeat, move and add chunks, mostly with matching CRCs."""
    if data[:8] != _PNG or random.random() < 0.1:
        return break_bytes(random, data, other)
    chunks = _chunks(data)
    for _ in range(random.choice((1, 1, 2, 3))):
        at = random.randrange(len(chunks)) if random.random() < 0.6 else 0
        kind, body = chunks[at] if chunks else (b"IHDR", bytes(13))
        match random.randrange(9):
            case 0:
                del chunks[at : at + 1]
            case 1:
                chunks.insert(at, (kind, body))
            case 2:
                random.shuffle(chunks)
            case 3:
                chunks.insert(max(at, 1), _extra_chunk(random))
            case 4 if kind == b"IHDR" and len(body) == 13:
                width, height = (random.choice((0, 1, 2, 100, 1000, 8000, 16384, 16385, 1 << 31)) for _ in range(2))
                chunks[at] = (kind, struct.pack(">II", width & 0xFFFFFFFF, height & 0xFFFFFFFF) + body[8:])
            case 5 if kind == b"IHDR" and len(body) == 13:
                depth, colour = random.choice((1, 2, 4, 8, 16, 3, 0)), random.choice((0, 2, 3, 4, 6, 1, 7))
                chunks[at] = (kind, body[:8] + bytes((depth, colour, random.randrange(2), 0, random.randrange(3))))
            case 6:
                content = random.choice((bytes(10), bytes(1 << 20), random.randbytes(1000), b"\5" * 1000))
                chunks = [(name, zlib.compress(content) if name == b"IDAT" else part) for name, part in chunks]
            case _ if chunks:
                chunks[at] = (kind, random.choice((break_words, break_bytes))(random, body, other))
    crc = random.random() < 0.95
    return _PNG + b"".join(_chunk(kind, body, good=crc) for kind, body in chunks)


def _chunks(data: bytes) -> list[tuple[bytes, bytes]]:
    found, at = [], 8
    while at + 8 <= len(data):
        size = int.from_bytes(data[at : at + 4], "big")
        found.append((data[at + 4 : at + 8], data[at + 8 : at + 8 + size]))
        at += 12 + size
    return found


def _chunk(kind: bytes, body: bytes, *, good: bool) -> bytes:
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body) ^ (not good))


def _extra_chunk(random: Random) -> tuple[bytes, bytes]:
    bomb = zlib.compress(bytes(1 << 22))
    return random.choice(
        (
            (b"tRNS", random.randbytes(random.choice((1, 2, 6, 256)))),
            (b"PLTE", random.randbytes(random.choice((0, 3, 4, 768, 900)))),
            (b"gAMA", hostile.word(random, 4)),
            (b"zTXt", b"k\0\0" + bomb),
            (b"iTXt", b"k\0\1\0\0\0" + bomb),
            (b"iCCP", b"k\0\0" + bomb),
            (b"acTL", struct.pack(">II", hostile.whole(random) & 0xFFFFFFFF, 0)),
            (b"fcTL", random.randbytes(26)),
            (b"fdAT", random.randbytes(40)),
            (b"eXIf", b"MM\0*" + random.randbytes(60)),
            (b"pHYs", random.randbytes(9)),
            (b"tEXt", b"\xff\0" + random.randbytes(10)),
            (b"IEND", b""),
            (b"ABCD", b""),
        )
    )


def break_glb(random: Random, data: bytes, other: bytes = b"") -> bytes:
    """Change the JSON (accessors, views, materials, the node graph) or the binary chunk, or break the file as bytes."""
    if len(data) < 20 or random.random() < 0.1:
        return break_bytes(random, data, other)
    size = int.from_bytes(data[12:16], "little")
    text, rest = data[20 : 20 + size], data[20 + size :]
    body = rest[8:]
    tree = parse(text)
    for _ in range(random.choice((1, 1, 2, 3))):
        match random.randrange(6):
            case 0:
                body = break_words(random, body, other) if random.random() < 0.7 else break_bytes(random, body, other)
            case 1:
                tree = _with_nodes(random, tree)
            case 2:
                tree = _retyped(random, tree)
            case _:
                tree = break_tree(random, tree)
    return glb_of(spell(tree).encode("utf-8", "surrogatepass"), body)


def glb_of(text: bytes, body: bytes) -> bytes:
    text += b" " * (-len(text) % 4)
    total = 12 + 8 + len(text) + 8 + len(body)
    return (
        struct.pack("<4sIII4s", b"glTF", 2, total, len(text), b"JSON")
        + text
        + struct.pack("<I4s", len(body), b"BIN\0")
        + body
    )


def _with_nodes(random: Random, tree: Any) -> Any:
    """Replace the node graph: deep, wide or with cycles, with transforms of zero or huge scale."""
    count = random.choice((1, 2, 5, 50, 3000))
    kind = random.choice(("chain", "star", "random", "loose"))

    def node(i: int) -> Pairs:
        found = Pairs()
        if random.random() < 0.5:
            found.append(("mesh", random.choice((0, 0, 0, 1, -1, 10**20))))
        if kind == "chain" and i + 1 < count:
            found.append(("children", [i + 1]))
        elif kind == "star" and i == 0:
            found.append(("children", list(range(1, count))))
        elif kind == "random":
            found.append(("children", [random.randrange(count) for _ in range(random.randrange(3))]))
        if random.random() < 0.3:
            name, size = random.choice((("scale", 3), ("translation", 3), ("rotation", 4), ("matrix", 16)))
            found.append((name, [Raw(repr(hostile.real(random)).replace("inf", "1e999")) for _ in range(size)]))
        return found

    if not isinstance(tree, Pairs):
        return tree
    scene = [Pairs([("nodes", [0] if kind != "loose" else list(range(count)))])]
    replaced = {"nodes": [node(i) for i in range(count)], "scenes": scene}
    return Pairs([pair for pair in tree if pair[0] not in replaced] + list(replaced.items()))


def _retyped(random: Random, tree: Any) -> Any:
    """Change a property of an accessor, view, mesh, image, texture or material."""
    lists = dict(tree) if isinstance(tree, Pairs) else {}
    entries = lists.get(
        random.choice(("accessors", "bufferViews", "buffers", "meshes", "images", "textures", "materials"))
    )
    if not isinstance(entries, list) or not entries or not isinstance(entries[0], Pairs):
        return tree
    choices: dict[str, Any] = {
        "componentType": random.choice((5120, 5121, 5122, 5123, 5125, 5126, 5124, 0)),
        "count": hostile.whole(random),
        "type": random.choice(("SCALAR", "VEC2", "VEC3", "VEC4", "MAT4", 3)),
        "sparse": _sparse(random),
        "uri": random.choice(("data:;base64,AAAA" + "AAAA" * 20, "data:;base64,A", "a.bin", 5)),
        "normalized": random.choice((True, False, 1)),
        "byteOffset": hostile.whole(random),
        "byteLength": hostile.whole(random),
        "byteStride": random.choice((0, 1, 4, 12, 252, 1 << 40)),
        "bufferView": random.choice((0, 1, 2, -1, 1 << 70, "0")),
        "source": random.choice((0, 1, -1, True)),
        "primitives": [Pairs([("attributes", Pairs([("POSITION", 0)])), ("mode", random.randrange(8))])] * 3,
        "pbrMetallicRoughness": Pairs([("baseColorFactor", [hostile.real(random) for _ in range(4)])]),
    }
    entry = random.choice(entries)
    if not isinstance(entry, Pairs):
        return tree
    name = random.choice([key for key, _ in entry if key in choices] or list(choices))
    value = choices[name]
    entry[:] = [pair for pair in entry if pair[0] != name] + [(name, value)]
    return tree


def _sparse(random: Random) -> Any:
    indices = Pairs(
        [("bufferView", random.randrange(4)), ("componentType", random.choice((5121, 5123, 5125, 5126, 0)))]
    )
    return Pairs(
        [
            ("count", random.choice((0, 1, 2, 3, hostile.whole(random)))),
            ("indices", random.choice((indices, 5))),
            ("values", random.choice((Pairs([("bufferView", random.randrange(4))]), indices, None))),
        ]
    )


def break_ply(random: Random, data: bytes, other: bytes = b"") -> bytes:
    """Change, remove, repeat and insert lines of the header, or of the rows in text, or change the rows as numbers."""
    at = data.find(b"end_header")
    if random.random() < 0.1 or at < 0:
        return break_bytes(random, data, other)
    if random.random() < 0.4 and b"ascii" not in data[:at]:
        return data[: at + 11] + break_words(random, data[at + 11 :], other)
    lines = data.split(b"\n") if b"ascii" in data[:at] else [*data[:at].split(b"\n")[:-1], data[at:]]
    for _ in range(random.choice((1, 1, 2, 4))):
        k = random.randrange(len(lines))
        words = lines[k].split(b" ")
        match random.randrange(8):
            case 0:
                del lines[k : k + 1]
            case 1:
                lines[k:k] = lines[k : k + 1] * random.choice((1, 3))
            case 2:
                lines.insert(k, random.choice(_HEADS))
            case 3:
                lines[k : k + 2] = [b" ".join(lines[k : k + 2])]
            case 4:
                lines[k : k + 1] = [b" ".join(words[:1]), b" ".join(words[1:])]
            case 5 if len(words) > 1:
                words[random.randrange(len(words))] = random.choice(_PLY_WORDS)
                lines[k] = b" ".join(words)
            case _ if len(words) > 1:
                words[random.randrange(1, len(words))] = _obj_word(random)
                lines[k] = b" ".join(words)
        lines = lines or [b""]
    joined = b"\n".join(lines)
    return joined.replace(b"\n", b"\r") if random.random() < 0.05 else joined


_HEADS = [b"comment x", b"by hand", b"", b"end_header", b"property float x", b"property list uchar int vertex_indices"]
_HEADS += [b"element face 2", b"element tristrips 1", b"element edge 1", b"property list float int vertex_indices"]
_HEADS += [
    b"property double red",
    b"property double green",
    b"property double blue",
    b"property uchar alpha",
    b"3 0 1 2",
]
_PLY_WORDS = [b"vertex", b"face", b"tristrips", b"list", b"uchar", b"int", b"double", b"float", b"ushort", b"red", b"x"]
_PLY_WORDS += [
    b"ascii",
    b"binary_little_endian",
    b"binary_big_endian",
    b"vertex_indices",
    b"nan",
    b"-1",
    b"1e308",
    b"0",
]


def break_obj(random: Random, data: bytes, other: bytes = b"") -> bytes:
    """Change, remove and repeat lines and words, and insert other statements."""
    if random.random() < 0.1:
        return break_bytes(random, data, other)
    lines = data.split(b"\n")
    for _ in range(random.choice((1, 1, 2, 4))):
        at = random.randrange(len(lines)) if lines else 0
        words = lines[at].split(b" ") if lines else []
        match random.randrange(8):
            case 0:
                del lines[at : at + 1]
            case 1:
                lines[at:at] = lines[at : at + 1] * random.choice((1, 3, 200))
            case 2:
                lines.insert(at, random.choice(_STATEMENTS))
            case 3:
                random.shuffle(lines)
            case 4:
                lines[at : at + 1] = [b" ".join(words[: random.randrange(len(words) + 1)])]
            case _ if len(words) > 1:
                words[random.randrange(1, len(words))] = _obj_word(random)
                lines[at] = b" ".join(words)
    return b"\n".join(lines)


_STATEMENTS = [b"usemtl a", b"usemtl b", b"o x", b"g y z", b"s off", b"mtllib ../../x.mtl", b"vn 0 0 1", b"vt 0", b"v"]
_STATEMENTS += [
    b"f 1 2 3",
    b"f 1/1/1 2/1/1 3/1/1",
    b"f 1//1 2//1 3//1",
    b"f -1 -2 -3",
    b"f 1 2",
    b"f",
    b"l 1 2",
    b"p 1",
]
_STATEMENTS += [
    b"f 1 2 3 4 5 6 7 8 9",
    b"v 1 2 3 4",
    b"v 1 2 3 0.1 0.2 0.3",
    b"v 1e39 0 0",
    b"v nan inf 0",
    b"#",
    b"\\",
]
_STATEMENTS += [
    b"v 0 1 0 nan 0 0",
    b"v 0 1 0 1 0 0 1",
    b"v 1 0 0 255 1e300 -inf",
    b"vt nan -1.#IND",
    b"#MRGB ffff0000ff00ff",
    b"#MRGB " + 300 * b"ff",
    b"f 1 2 \\",
    b"f ",
    b"mtllib a/b.mtl",
]
_STATEMENTS += [
    b"f 1/1 2/2 3",
    b"f 1/ 2/ 3/",
    b"\xff\xfe",
    b"f 1.5 2 3",
    b"f 0 0 0",
    b"v 1 2",
    b"vt 1 2 3",
    b"curv 0 1",
]


def _obj_word(random: Random) -> bytes:
    match random.randrange(6):
        case 0:
            return str(hostile.whole(random)).encode()
        case 1 | 2:
            return repr(hostile.real(random)).encode()
        case 3:
            return b"/".join(str(hostile.whole(random)).encode() for _ in range(random.randrange(1, 4)))
        case 4:
            return random.choice((b"9" * 400, b"1e999", b"1_0", b"0x1", b"--1", b"/", b"//", b"1/", b"\0", b"\xc3"))
        case _:
            return str(random.randrange(-5, 30)).encode()


def break_vdb(random: Random, data: bytes, other: bytes = b"") -> bytes:
    """Change numbers: counts, offsets, masks and origins. Zeros, which fill most of a small file, are not selected."""
    if random.random() < 0.1:
        return break_bytes(random, data, other)
    broken = bytearray(data)
    said = [at for at in range(0, len(data) - 8) if data[at]] or [0]
    for _ in range(random.choice((1, 1, 2, 4))):
        at, width = random.choice(said), random.choice((1, 2, 4, 8))
        if random.random() < 0.7:
            at -= at % width
        part = bytes(broken[at : at + width])
        step = (int.from_bytes(part, "little") + random.choice((-1, 1, 2, 8))) & ((1 << 8 * width) - 1)
        broken[at : at + width] = random.choice((hostile.word(random, width), step.to_bytes(width, "little")))
    return bytes(broken)
