"""Break torch files, mostly the program in their pickle."""

from __future__ import annotations

import pickletools
from itertools import pairwise
from random import Random

from nerfbake.formats.wire.torch_writer import glob, text
from tests.fuzz import hostile_values as hostile
from tests.fuzz.breaking_bytes import break_bytes, break_words
from tests.fuzz.breaking_zip import archive_of, break_zip, members_of

_PICKLE = "data.pkl"
# Insertions of a hostile author: calls, globals, opcodes of other protocols, copies, ends.
_PIECES = [
    glob("os", "system") + text("true") + b"\x85R",
    glob("builtins", "eval") + text("1") + b"\x85R",
    glob("collections", "OrderedDict") + b")R",
    glob("torch", "FloatStorage"),
    glob("torch._utils", "_rebuild_tensor_v2"),
    glob("numpy.core.multiarray", "_reconstruct") + b")R",
    *(bytes([code]) for code in b"(.0123NQRbdeiloqrsu\x81\x82\x85\x86\x87\x88\x8a\x8c\x92\x93\x94\x95\x97"),
    b"J\xff\xff\xff\xff",
    b"\x8a\xff" + b"\x7f" * 255,
    b"h\x00",
    b"r\xff\xff\xff\x7f",
    b"X\xff\xff\xff\xff",
    b"}" * 3000,
    b"(" * 3000,
    b"]\x85" * 3000,
]


def break_torch(random: Random, data: bytes, other: bytes = b"") -> bytes:
    """Remove, repeat, copy or insert an opcode, change a number in the pickle, or break the archive."""
    members = members_of(data)
    name = next((each for each in members if each.endswith(_PICKLE)), "")
    if random.random() < 0.25 or not name:
        return break_zip(random, data, other)
    if random.random() < 0.1:
        storage = random.choice([each for each in members if "/data/" in each])
        members[storage] = break_words(random, members[storage]) if random.random() < 0.7 else members[storage][:-4]
    else:
        members[name] = _broken(random, members[name])
    return archive_of(list(members.items()), stored=random.random() < 0.9)


def _broken(random: Random, code: bytes) -> bytes:
    places = [place for _, _, place in pickletools.genops(code) if place is not None] + [len(code)]
    ops = [code[begin:end] for begin, end in pairwise(places)]
    at = random.randrange(len(ops))
    match random.randrange(8):
        case 0:
            del ops[at]
        case 1:
            ops.insert(at, ops[at])
        case 2:
            ops.insert(at, random.choice(ops))
        case 3 | 4:
            ops.insert(at, random.choice(_PIECES))
        case 5:
            numbers = [i for i, op in enumerate(ops) if op[:1] in b"KMJ"]
            ops[random.choice(numbers)] = random.choice((b"J" + hostile.word(random, 4), b"K\x00", b"K\xff"))
        case 6:
            ops = [*ops[:at], b"."]
        case _:
            return break_bytes(random, code)
    return b"".join(ops)
