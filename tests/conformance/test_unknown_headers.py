"""A flag, a version or a reserved byte that no reader knows is never ignored: it is refused or told by its name."""

from __future__ import annotations

import gzip
import io
import json
import struct
import zipfile
import zlib
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from nerfbake import EnvironmentMap, build_octree, build_vdb, load
from nerfbake.formats.octree import npz, svoq
from nerfbake.formats.splat import glb, ply, spz
from nerfbake.formats.volume import nanovdb, openvdb
from nerfbake.formats.volume import npz as volume_npz
from nerfbake.formats.wire import nanovdb as nano
from nerfbake.formats.wire.torch_writer import torch_file
from tests.support import environments
from tests.support.hostile import refused_as_it_is
from tests.support.meshes import polygon_ply
from tests.support.n3trees import archive
from tests.support.quantised import random_quantised
from tests.support.scenes import n3tree
from tests.support.splats import gzip_spz, packed_ply, sog_files, sog_zip, splats
from tests.support.svraster import svraster, voxels


def changed(data: bytes, at: int, value: bytes) -> bytes:
    return data[:at] + value + data[at + len(value) :]


def of(pieces: Any) -> bytes:
    return b"".join(bytes(piece) for piece in pieces)


@cache
def octree() -> Any:
    return build_octree(n3tree(splits=[(0, (0, 0, 0))], data_format="SH4"))


@cache
def nvdb() -> bytes:
    return of(nanovdb.encode(build_vdb(octree(), grids=("density",))))


@cache
def vdb() -> bytes:
    return of(openvdb.encode(build_vdb(octree(), grids=("density",))))


def with_array(data: bytes, name: str, value: int) -> bytes:
    with np.load(io.BytesIO(data)) as arrays:
        return archive({**arrays, name: np.int64(value)})


def svoq_with(at: int) -> bytes:
    """A sound checksum around a byte of 1."""
    body = changed(of(svoq.encode(random_quantised(0, levels=2))), at, b"\1")[:-4]
    return body + struct.pack("<I", zlib.crc32(body))


def of_grid(field: str, value: int) -> bytes:
    """The field of GridData, in a file without a checksum."""
    at = nvdb().index(b"NanoVDB0", 8)
    _kind, offset = nano.GRID.fields[field][:2]  # type: ignore[index]  # the fields exist
    data = changed(nvdb(), at + 8, struct.pack("<Q", 2**64 - 1))
    return changed(data, at + offset, struct.pack("<I", value))


def torch_with(name: str, value: bytes) -> bytes:
    file = io.BytesIO(torch_file(svraster(voxels(depth=2))))
    with zipfile.ZipFile(file) as old:
        members = {info.filename: old.read(info) for info in old.infolist()}
    prefix = next(member for member in members if member.endswith("/data.pkl")).removesuffix("data.pkl")
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as new:
        for member, data in (members | {prefix + name: value}).items():
            new.writestr(member, data)
    return file.getvalue()


def sog_with(**fields: Any) -> bytes:
    files = sog_files(splats(9, degree=0))
    meta = json.loads(files["meta.json"]) | fields
    return sog_zip({**files, "meta.json": json.dumps(meta).encode()})


def glb_with(change: Callable[[dict[str, Any]], object]) -> bytes:
    data = of(glb.encode(splats(3, degree=0)))
    size = struct.unpack_from("<I", data, 12)[0]
    document = json.loads(data[20 : 20 + size])
    change(document)
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    rest = data[20 + size :]
    return b"glTF" + struct.pack("<III4s", 2, 20 + len(text) + len(rest), len(text), b"JSON") + text + rest


def npy(version: int) -> bytes:
    file = io.BytesIO()
    np.save(file, np.ones((2, 2), np.float32))
    return changed(file.getvalue(), 6, bytes([version]))


SPZ3, SPZ4 = gzip.decompress(gzip_spz(splats(3), 3)), of(spz.encode(splats(3)))
PLY = of(ply.encode(splats(3, degree=0)))
UNKNOWN: dict[str, tuple[Callable[[], bytes], str]] = {
    "flag.spz": (
        lambda: changed(SPZ3, 14, b"\x08"),
        "the flags have 0x08; allowed: 1 antialiased, 2 extensions, 0x80 levels",
    ),
    "flag of 4.spz": (lambda: changed(SPZ4, 14, b"\x80"), "the flags have 0x80; allowed: 1 antialiased, 2 extensions"),
    "version.spz": (lambda: changed(SPZ4, 4, b"\x09"), "version is 9"),
    "version.sog": (lambda: sog_with(version=3), "meta.json: version is 3; allowed: 2, or no version"),
    "version.ply": (
        lambda: PLY.replace(b"endian 1.0", b"endian 2.0"),
        "has the line 'format binary_little_endian 2.0'",
    ),
    "version of packed.ply": (lambda: packed_ply(splats(3)).replace(b" 1.0", b" 1.1"), "has the line 'format"),
    "version of a mesh.ply": (
        lambda: polygon_ply([(0, 1, 2)]).replace(b" 1.0", b" 3"),
        "has the line 'format ascii 3'",
    ),
    "header.glb": (lambda: changed(glb_with(lambda _: None), 4, b"\3"), "header has version 3"),
    "version.glb": (
        lambda: glb_with(lambda each: each["asset"].update(version="3.0")),
        "asset.version is 3.0; allowed: 2.0",
    ),
    "least version.glb": (
        lambda: glb_with(lambda each: each["asset"].update(minVersion="2.1")),
        "asset.minVersion is 2.1",
    ),
    "extension.glb": (
        lambda: glb_with(lambda each: each.update(extensionsRequired=["X_new"])),
        "extensionsRequired has X_new",
    ),
    "version.svoq": (
        lambda: changed(of(svoq.encode(random_quantised(0, levels=2))), 4, b"\2"),
        "version is 2; allowed: 1",
    ),
    "reserved.svoq": (lambda: svoq_with(14), "the bytes before masks are 1; allowed: 0, as in version 1"),
    "reserved of a part.svoq": (lambda: svoq_with(104 + 2), "a line of the table of parts has bytes that are not 0"),
    "version.svo.npz": (lambda: with_array(of(npz.encode(octree())), "svo_version", 2), "svo_version is 2; allowed: 1"),
    "version.vdb.npz": (
        lambda: with_array(of(volume_npz.encode(build_vdb(octree(), grids=("density",)))), "vdb_version", 3),
        "vdb_version is 3; allowed: 1, 2",
    ),
    "version of an array.depth.npy": (lambda: npy(4), "an array (.npy, version 1 to 3)"),
    "major version.nvdb": (
        lambda: changed(nvdb(), 8, struct.pack("<I", 33 << 21)),
        "the file has version 33.0; allowed: 32",
    ),
    "major version of a grid.nvdb": (
        lambda: of_grid("version", 31 << 21 | 2 << 10),
        "GridData has version 31.2; allowed: 32",
    ),
    "flags.nvdb": (lambda: of_grid("flags", 0x40 | 2), "GridData has flags 0x40; allowed: 0x3f"),
    "codec.nvdb": (lambda: changed(nvdb(), 16 + 168, b"\3"), "the grid has codec 3"),
    "version.vdb": (lambda: changed(vdb(), 8, struct.pack("<I", 230)), "the file has version 230; allowed: 222 to 225"),
    "offsets.vdb": (lambda: changed(vdb(), 20, b"\2"), "the file has 2 as its flag of offsets; allowed: 0 or 1"),
    "order.pt": (lambda: torch_with("byteorder", b"middle"), "byteorder is b'middle'; allowed: little or big"),
    "version.pt": (lambda: torch_with("version", b"11\n"), "version is b'11'; allowed: 1 to 10"),
    "format.hdr": (lambda: environments.flat().replace(b"rgbe\n", b"xyze\n"), "FORMAT is '32-bit_rle_xyze'"),
    "colours.hdr": (lambda: environments.flat().replace(b"\n\n", b"\nCOLORCORR=1 2\n\n", 1), "COLORCORR is '1 2'"),
    "flags of gzip.ply": (lambda: changed(gzip.compress(PLY), 3, b"\x20"), "gzip is damaged ("),
    "method of gzip.ply": (lambda: changed(gzip.compress(PLY), 2, b"\x09"), "the header does not end within"),
    "flags of zstd.ply.zst": (lambda: b"\x28\xb5\x2f\xfd\x08" + bytes(20), "zstd"),
}


@pytest.mark.parametrize("name", UNKNOWN)
def test_an_unknown_header_is_refused_by_name(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    content, told = UNKNOWN[name]
    assert told in refused_as_it_is(tmp_path / name, content(), capsys)


@pytest.mark.parametrize("bit", [0, 5, 6, 13])
def test_a_member_of_an_archive_that_is_not_plain_is_refused(
    bit: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data = of(npz.encode(octree()))
    at = data.index(b"PK\1\2")
    bad = changed(data, at + 8, struct.pack("<H", 1 << bit))
    assert "stored or deflated, not encrypted" in refused_as_it_is(tmp_path / "bad.svo.npz", bad, capsys)


def test_what_is_known_is_read(tmp_path: Path) -> None:
    """The files of which UNKNOWN changes a byte."""
    sound = {
        "a.ply": PLY, "a.glb": glb_with(lambda each: each["asset"].update(version="2.1", minVersion="2.0")),
        "a.nvdb": of_grid("flags", 2), "a.vdb": vdb(), "a.pt": torch_with("byteorder", b"little"),
        "a.sog": sog_with(model="2dgs"), "a.depth.npy": npy(1), "a.spz": SPZ3,
        "a.hdr": environments.flat().replace(b"\n\n", b"\nCOLORCORR=1 2 4\n\n", 1),
    }  # fmt: skip
    for name, data in sound.items():
        (tmp_path / name).write_bytes(data)
        load(tmp_path / name)


def test_the_correction_of_colours_is_a_factor_of_each(tmp_path: Path) -> None:
    (tmp_path / "a.hdr").write_bytes(environments.flat())
    (tmp_path / "b.hdr").write_bytes(environments.flat().replace(b"\n\n", b"\nCOLORCORR=1 2 4\n\n", 1))
    plain, found = (load(tmp_path / f"{name}.hdr", EnvironmentMap).radiance for name in "ab")
    np.testing.assert_allclose(found, plain / [1, 2, 4], rtol=1e-6)


def test_an_unknown_model_of_a_sog_is_told(tmp_path: Path) -> None:
    (tmp_path / "a.sog").write_bytes(sog_with(model="4dgs"))
    assert load(tmp_path / "a.sog").notes == ("its model is '4dgs', which is read as 'default'",)
