"""Create the broken file or folder of a case from its number."""

from __future__ import annotations

import gzip
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from random import Random

import zstandard

from nerfbake import catalog
from tests.fuzz import corpus, hostile_values
from tests.fuzz.breaking_bytes import break_bytes, break_words
from tests.fuzz.breaking_json import break_json, break_json_lines
from tests.fuzz.breaking_media import break_glb, break_obj, break_ply, break_png, break_svoq, break_vdb
from tests.fuzz.breaking_msgpack import break_msgpack
from tests.fuzz.breaking_torch import break_torch
from tests.fuzz.breaking_wires import break_bson, break_capnp, break_flatbuffers, break_protobuf
from tests.fuzz.breaking_zip import archive_of, break_npy, break_zip, members_of

_GZIP = b"\x1f\x8b"
Breaker = Callable[[Random, bytes, bytes], bytes]

# By file extension. The first match counts.
_BREAKERS: dict[str, Breaker] = {
    "npz": break_zip,
    "tar": break_torch,
    "th": break_torch,
    "pt": break_torch,
    "pth": break_torch,
    "ckpt": break_torch,
    "msgpack": break_msgpack,
    "ingp": lambda random, data, other: _broken_ingp(random, data, other),
    "yml": break_obj,
    "svo.pb": break_protobuf,
    "json": break_json,
    "jsonl": break_json_lines,
    "bson": break_bson,
    "fb": break_flatbuffers,
    "capnp": break_capnp,
    "npy": break_npy,
    "png": break_png,
    "jpg": break_bytes,
    "vdb": break_vdb,
    "nvdb": break_vdb,
    "svoq": break_svoq,
    "obj": break_obj,
    "txt": break_obj,
    "bin": break_words,
    "mtl": break_obj,
    "glb": break_glb,
    "ply": break_ply,
    "usda": break_obj,
    "usdc": break_words,
    "usdz": lambda random, data, other: _broken_archive(random, data, other),
    "sog": lambda random, data, other: _broken_archive(random, data, other),
    "splat": break_words,
    "spz": lambda random, data, other: _broken_spz(random, data, other),
}


@dataclass(frozen=True)
class Case:
    """A broken file or folder, with its name and contents."""

    number: int
    form: str
    name: str
    content: bytes | dict[str, bytes]


def case_of(seed: int, number: int) -> Case:
    """Return a case. The same seed and number always give the same case."""
    form = corpus.names()[number % len(corpus.names())]
    random = Random(f"{seed}:{number}")
    if corpus.is_folder(form):
        return Case(number, form, f"case.{form}", _broken_folder(random, form))
    suffix = next((each.suffix for each in catalog.FORMATS if each.name == form), f".{form}")
    files = corpus.files_of(form)
    data = _broken(random, form, random.choice(files), random.choice(files))
    if random.random() < 0.1:
        data, suffix = _compressed(random, data), suffix + ".zst"
    elif random.random() < 0.1:
        data, suffix = _wrapped(random, data, suffix)
    return Case(number, form, f"case{suffix}", data)


def _broken(random: Random, name: str, data: bytes, other: bytes) -> bytes:
    breaker = next((breaker for ending, breaker in _BREAKERS.items() if name.endswith(ending)), break_bytes)
    if random.random() < 0.02:
        name = random.choice([name for name in corpus.names() if not corpus.is_folder(name)])
        return break_bytes(random, data, random.choice(corpus.files_of(name)))
    for _ in range(random.choice((1, 1, 1, 2))):
        try:
            data = breaker(random, data, other)
        except Exception:  # the file is already too broken for its breaker
            data = break_bytes(random, data, other)
    return data


def _broken_archive(random: Random, data: bytes, other: bytes) -> bytes:
    """Break a file in a zip archive as its extension asks, or the archive itself."""
    if random.random() < 0.2:
        return break_zip(random, data, other)
    members, others = members_of(data), members_of(other)
    name = random.choice(sorted(members))
    breaker = next((breaker for ending, breaker in _BREAKERS.items() if name.endswith(ending)), break_bytes)
    members[name] = breaker(random, members[name], others.get(name, b""))
    return archive_of(list(members.items()), stored=random.random() < 0.5)


def _gzipped(data: bytes) -> bytes:
    return gzip.compress(data, 1, mtime=0)


def _broken_spz(random: Random, data: bytes, other: bytes) -> bytes:
    """Break what is inside gzip, whose checksum would otherwise find every change."""
    if data[:2] != _GZIP or random.random() < 0.1:
        return break_bytes(random, data, other)
    inner = gzip.decompress(data)
    return _gzipped(break_bytes(random, inner, gzip.decompress(other) if other[:2] == _GZIP else other))


def _broken_ingp(random: Random, data: bytes, other: bytes) -> bytes:
    """Break the map in gzip or zlib, whose checksums would otherwise find every change."""
    if random.random() < 0.1:
        return break_bytes(random, data, other)
    inner = gzip.decompress(data) if data[:2] == _GZIP else zlib.decompress(data)
    return _gzipped(break_msgpack(random, inner))


def _wrapped(random: Random, data: bytes, suffix: str) -> tuple[bytes, str]:
    """Put a file into gzip or a zip archive: whole, damaged, twice, beside others, or with a bomb."""
    if random.random() < 0.5:
        packed = _gzipped(data)
        if (kind := random.randrange(4)) == 0:
            packed = break_bytes(random, packed, data)
        elif kind == 1:
            packed += _gzipped(bytes(random.choice((0, 1, 1 << 20, 1 << 26))))
        elif kind == 2:
            packed = _gzipped(packed)
        return packed, suffix + random.choice((".gz", ""))
    folder = random.choice(("", "a/", "__MACOSX/", "../", "a/b/c/"))
    members = [(f"{folder}case{suffix}", data)]
    if random.random() < 0.5:
        members.append((random.choice(("._case", "meta.json", "b/case" + suffix, "a.png", "x.txt")), data[:9]))
    packed = archive_of(members, stored=random.random() < 0.5)
    inside = b"" if data[:2] == b"PK" else data  # a broken archive would end break_zip()
    return break_zip(random, packed, inside) if random.random() < 0.4 else packed, random.choice((".zip", suffix))


def _broken_folder(random: Random, form: str) -> dict[str, bytes]:
    folders = corpus.folders_of(form)
    files = dict(random.choice(folders))
    for _ in range(random.choice((1, 1, 2))):
        name = random.choice(sorted(files))
        match random.randrange(10):
            case 0:
                del files[name]
            case 1:
                files[name] = files[random.choice(sorted(files))]
            case 2:
                files[name] = random.choice(folders).get(name, b"")
            case 3:
                new = random.choice(("feat1_0.jpg", "feat0_0.jpg", "mlp.json", "atlas.json", "labels_0.png", "x\n"))
                files[new] = files[name]
            case _:
                files[name] = _broken(random, name, files[name], random.choice(folders).get(name, b""))
        if not files:
            break
    return files


def _compressed(random: Random, data: bytes) -> bytes:
    """Compress with Zstandard: in one frame, damaged, in several frames, or with skippable or zero frames appended."""
    frame = zstandard.ZstdCompressor(level=1).compress(data)
    match random.randrange(6):
        case 0:
            return break_bytes(random, frame, data)
        case 1:
            skippable = b"\x50\x2a\x4d\x18" + (4).to_bytes(4, "little") + hostile_values.word(random, 4)
            return frame + skippable * random.choice((1, 1000))
        case 2:
            half = len(data) // 2
            return b"".join(zstandard.ZstdCompressor(level=1).compress(part) for part in (data[:half], data[half:]))
        case 3:
            return frame + zstandard.ZstdCompressor(level=1).compress(bytes(random.choice((1, 1 << 20, 1 << 26))))
        case _:
            return frame
