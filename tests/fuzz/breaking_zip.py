"""Break .npy arrays and the zip archives that contain them."""

from __future__ import annotations

import io
import struct
import zipfile
import zlib
from random import Random

from tests.fuzz import hostile_values as hostile
from tests.fuzz.breaking_bytes import break_bytes, break_words

_DTYPES = [
    "'<f4'",
    "'<f8'",
    "'<f2'",
    "'<i4'",
    "'|i1'",
    "'|u1'",
    "'<i8'",
    "'>i4'",
    "'>f4'",
    "'<u8'",
    "'<U1'",
    "'<U9999'",
]
_DTYPES += ["'|O'", "'O'", "'<c16'", "'|b1'", "'<M8[s]'", "'|S5'", "'|V8'", "[('a', '<i4')]", "None", "'=f4'", "'<f16'"]
_DTYPES += ["1_f4", "0777", "'<f4' if 1else 2", "'\\x00'", "'\\ud800'", "b'<f4'"]
# {offset: width} of method, CRC, sizes, name and offset in a central-directory record and in a local header.
_DIRECTORY = {8: 2, 10: 2, 16: 4, 20: 4, 24: 4, 28: 2, 30: 2, 32: 2, 42: 4}
_LOCAL = {6: 2, 8: 2, 14: 4, 18: 4, 22: 4, 26: 2, 28: 2}
_END = {4: 2, 8: 2, 10: 2, 12: 4, 16: 4, 20: 2}


def break_npy(random: Random, data: bytes, other: bytes = b"") -> bytes:
    """Change the header or the values of an array."""
    size = int.from_bytes(data[8:10], "little")
    text, body = data[10 : 10 + size].decode("latin-1"), data[10 + size :]
    if random.random() < 0.35 or "'shape': (" not in text:
        return data[: 10 + size] + break_words(random, body) if random.random() < 0.8 else break_bytes(random, data)
    before, _, rest = text.partition("'shape': (")
    shape, _, after = rest.partition(")")
    edges = [edge.strip() for edge in shape.split(",") if edge.strip()]
    match random.randrange(10):
        case 0 | 1 | 2:
            edges = _edges(random, edges)
        case 3:
            before = before.replace("False", random.choice(("True", "0", "None", "1if 1else 2", "'True'")))
        case 4 | 5:
            start, end = before.find("'descr': ") + 9, before.find(", 'fortran")
            before = before[:start] + random.choice(_DTYPES) + before[end:]
        case 6:
            edges, body = [*edges, "0"], b""  # an empty array with a huge shape
            random.shuffle(edges)
            edges[edges.index("0") - 1] = str(1 << random.choice((20, 31, 40, 47)))
        case 7:
            after = random.choice((after[:-3], after + "}", " " * 70_000, after.replace("}", ", 1: 2}"), "(" * 3000))
        case 8:
            before = random.choice((before.replace("descr", "desc"), "{" + before, "\n" + before, before + "1_00, "))
        case _:
            return data[:6] + bytes([random.randrange(5)]) + data[7:]
    shape = ", ".join(edges) + ("," if len(edges) == 1 else "")
    header = f"{before}'shape': ({shape}){after}".encode("latin-1", "replace")[:65535]
    return data[:8] + len(header).to_bytes(2, "little") + header + body


def _edges(random: Random, edges: list[str]) -> list[str]:
    at = random.randrange(len(edges) + 1)
    value = random.choice(
        (str(hostile.whole(random)), "0", "-0", "1_000", "1.5", "True", "'3'", "9" * 400, "0x10", "1j")
    )
    match random.randrange(4):
        case 0:
            return edges[:at] + edges[at + 1 :]
        case 1:
            return [*edges[:at], random.choice(("1", "0", value)), *edges[at:]]
        case 2:
            return edges[::-1]
        case _:
            return [*edges[:at], value, *edges[at + 1 :]]


def break_zip(random: Random, data: bytes, other: bytes = b"") -> bytes:
    """Change, remove, repeat, rename or replace a member of the archive, or break its directory."""
    members = members_of(data)
    names = list(members)
    if random.random() < 0.25 or not names:
        return _break_directory(random, data)
    name, extra = random.choice(names), []
    match random.randrange(9):
        case 0:
            del members[name]
        case 1:
            members[random.choice((hostile.text(random)[:80] + ".npy", name[:-4], random.choice(names)))] = members[
                name
            ]
            del members[name]
        case 2:
            extra = [(name, members[name])]
        case 3:
            members[name] = members[random.choice(names)]
        case 4:
            members[name] = members_of(other).get(name, b"") if other[:2] == b"PK" else other
        case 5:
            extra = [(f"{i}.npy", b"") for i in range(random.choice((10, 1001, 3000)))]
        case _:
            for _ in range(random.choice((1, 1, 2))):
                name = random.choice(names)
                members[name] = break_npy(random, members[name])
    return archive_of([*members.items(), *extra], stored=random.random() < 0.5)


def members_of(data: bytes) -> dict[str, bytes]:
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def archive_of(members: list[tuple[str, bytes]], *, stored: bool) -> bytes:
    """Write a zip archive. zipfile is not used, because it warns about duplicate names."""
    body, directory = bytearray(), bytearray()
    for name, content in members:
        raw, place = name.encode("utf-8", "replace"), len(body)
        deflate = zlib.compressobj(wbits=-15)
        packed = content if stored else deflate.compress(content) + deflate.flush()
        common = (20, 0x800, 0 if stored else 8, 0, 33, zlib.crc32(content), len(packed), len(content), len(raw), 0)
        body += b"PK\3\4" + struct.pack("<5H3I2H", *common) + raw + packed
        directory += b"PK\1\2" + struct.pack("<H5H3I5H2I", 20, *common, 0, 0, 0, 0, place) + raw
    end = struct.pack("<4H2IH", 0, 0, len(members), len(members), len(directory), len(body), 0)
    return bytes(body + directory) + b"PK\5\6" + end


def _break_directory(random: Random, data: bytes) -> bytes:
    broken = bytearray(data)
    magic, fields = random.choice(((b"PK\1\2", _DIRECTORY), (b"PK\3\4", _LOCAL), (b"PK\5\6", _END)))
    places = [at for at in range(len(data) - 30) if data[at : at + 4] == magic] or [max(0, data.rfind(magic))]
    for _ in range(random.choice((1, 1, 2, 4))):
        offset, size = random.choice(list(fields.items()))
        at = random.choice(places) + offset
        broken[at : at + size] = hostile.word(random, size)
    return bytes(broken)
