"""Scenes in gzip and in zip archives, as people send them."""

from __future__ import annotations

import gzip
import io
import zipfile
from pathlib import Path

import numpy as np
import pytest
from PIL import Image as Pillow

from nerfbake import Meshes, NerfbakeError, Splats, load, memory_limit, sample_n3tree, save
from nerfbake.errors import InvalidFile, MemoryLimit
from nerfbake.formats.splat import ply, spz
from tests.support.hostile import refused_as_it_is
from tests.support.splats import gzip_spz, packed_ply, sog_files, sog_levels, sog_zip, splats

SCENE = splats(5, degree=1)
PLY = b"".join(ply.encode(SCENE))
SPZ = b"".join(spz.encode(SCENE))
OBJ = b"mtllib a.mtl\nusemtl a\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\nf 1/1 2/2 3/3\n"
MTL = b"newmtl a\nmap_Kd a.png\n"


def png() -> bytes:
    file = io.BytesIO()
    Pillow.new("RGB", (2, 2), (9, 8, 7)).save(file, "PNG")
    return file.getvalue()


def zipped(files: dict[str, bytes], method: int = zipfile.ZIP_DEFLATED) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", method) as archive:
        for name, data in files.items():
            archive.writestr(zipfile.ZipInfo(name), data, method)
    return file.getvalue()


MAC = {"__MACOSX/a/._a.ply": b"\0\5\x16\7", "a/.DS_Store": b"\0", "a/._b.ply": b"\0\5\x16\7"}
SENT = {
    "a.ply.gz": gzip.compress(PLY),
    "a.PLY.GZ": gzip.compress(PLY),
    "gzip under its old name.ply": gzip.compress(PLY),
    "two streams.ply.gz": gzip.compress(PLY[:99]) + gzip.compress(PLY[99:]),
    "filled with zeros.ply.gz": gzip.compress(PLY) + bytes(500),
    "a.zip": zipped({"a.ply": PLY}),
    "stored.zip": zipped({"a.ply": PLY}, zipfile.ZIP_STORED),
    "with its folder.zip": zipped({"a/": b"", "a/a.ply": PLY, "a/readme.txt": b"hello", "a/preview.png": png()}),
    "from a Mac.zip": zipped({**MAC, "a/a.ply": PLY}),
    "zip under another name.ply": zipped({"a.ply": PLY}),
    "gzip in zip.zip": zipped({"a.ply.gz": gzip.compress(PLY)}),
    "zip in gzip.zip.gz": gzip.compress(zipped({"a.ply": PLY})),
    "a.spz.gz": gzip.compress(SPZ),
    "version 4 in gzip.spz": gzip.compress(SPZ),
}


@pytest.mark.parametrize("name", SENT)
def test_splats_are_read_as_they_were_sent(name: str, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(SENT[name])
    found = load(tmp_path / name, Splats)
    np.testing.assert_allclose(found.means, SCENE.means, atol=1e-6)
    assert found.n == SCENE.n


def test_the_first_versions_of_spz_may_be_in_gzip_twice(tmp_path: Path) -> None:
    (tmp_path / "a.spz.gz").write_bytes(gzip.compress(gzip_spz(SCENE, 2)))
    assert load(tmp_path / "a.spz.gz", Splats).n == SCENE.n


def test_compressed_ply_is_read_from_a_zip(tmp_path: Path) -> None:
    (tmp_path / "a.zip").write_bytes(zipped({"a.compressed.ply": packed_ply(SCENE)}))
    assert load(tmp_path / "a.zip", Splats).n == SCENE.n


@pytest.mark.parametrize("folder", ["", "scene/", "a/b/"])
@pytest.mark.parametrize("name", ["a.sog", "a.zip"])
@pytest.mark.parametrize("levels", [False, True])
def test_a_sog_may_be_zipped_with_its_folder(folder: str, name: str, levels: bool, tmp_path: Path) -> None:
    """As the Finder packs it: with files of its own, of which one is another meta.json."""
    files = sog_levels() if levels else sog_files(SCENE)
    packed = {folder + name: data for name, data in files.items()}
    packed |= {f"__MACOSX/{folder}._{name}": b"\0\5\x16\7" for name in files}
    (tmp_path / name).write_bytes(sog_zip(packed))
    (tmp_path / "plain.sog").write_bytes(sog_zip(files))
    found, plain = load(tmp_path / name, Splats), load(tmp_path / "plain.sog", Splats)
    assert np.array_equal(found.means, plain.means)


def test_two_folders_of_sogs_are_two_scenes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    files = {f"{folder}/{name}": data for folder in "ab" for name, data in sog_files(SCENE).items()}
    told = refused_as_it_is(tmp_path / "bad.sog", sog_zip(files), capsys)
    assert "the archive has 2 scenes, in a/, b/; allowed: one scene" in told


@pytest.mark.data
def test_the_sogs_of_the_reports_are_one_scene(data: Path) -> None:
    mac, plain = (load(data / f"reports/F10_wrapped_files/{name}.sog", Splats) for name in ("mac", "plain"))
    assert np.array_equal(mac.means, plain.means)


@pytest.mark.parametrize("folder", ["", "chair/"])
def test_a_mesh_brings_its_materials_along(folder: str, tmp_path: Path) -> None:
    files = {f"{folder}a.obj": OBJ, f"{folder}a.mtl": MTL, f"{folder}a.png": png()}
    (tmp_path / "a.zip").write_bytes(zipped(files))
    (mesh,) = load(tmp_path / "a.zip", Meshes).meshes
    assert mesh.texture is not None
    assert mesh.texture[0, 0].tolist() == [9, 8, 7]


def test_a_mesh_in_gzip_has_its_materials_beside_it(tmp_path: Path) -> None:
    for name, data in (("a.obj.gz", gzip.compress(OBJ)), ("a.mtl", MTL), ("a.png", png())):
        (tmp_path / name).write_bytes(data)
    (mesh,) = load(tmp_path / "a.obj.gz", Meshes).meshes
    assert mesh.texture is not None


def test_an_archive_that_is_a_scene_is_no_wrapping(tmp_path: Path) -> None:
    tree = sample_n3tree(resolution=8)
    save(tmp_path / "a.npz", tree)
    (tmp_path / "renamed").write_bytes((tmp_path / "a.npz").read_bytes())
    (tmp_path / "a.zip").write_bytes(zipped({"a.npz": (tmp_path / "a.npz").read_bytes()}))
    for name in ("a.npz", "renamed", "a.zip"):
        assert np.array_equal(load(tmp_path / name).child, tree.child)


# -- hostile files ---------------------------------------------------------------------------------------------
def nested(times: int) -> bytes:
    data = PLY
    for _ in range(times):
        data = gzip.compress(data)
    return data


BAD = {
    "cut off.ply": (gzip.compress(PLY)[:-9], "gzip is cut off after"),
    "another CRC.ply": (gzip.compress(PLY)[:-8] + b"1234" + gzip.compress(PLY)[-4:], "gzip is damaged ("),
    "behind it.ply": (gzip.compress(PLY) + b"hello", "gzip is damaged ("),
    "empty.ply": (gzip.compress(b""), "is empty; allowed: a file that nerfbake reads"),
    "nested.ply": (nested(4), "is a file in more than 3 wrappings"),
    "two.zip": (zipped({"a.ply": PLY, "b/a.spz": SPZ}), "the archive has 2 scenes: a.ply, b/a.spz; allowed: one scene"),
    "nothing.zip": (zipped({"a.txt": b"hello"}), "which is no known format"),
    "damaged.zip": (zipped({"a.ply": PLY}, zipfile.ZIP_STORED).replace(b"f_dc_0", b"f_dc_O"), "a.ply has CRC-32"),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD)
def test_a_bad_wrapping_is_one_line(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    content, told = BAD[name]
    assert told in refused_as_it_is(tmp_path / name, content, capsys)


@pytest.mark.parametrize("name", ["bomb.ply.gz", "bomb.zip"])
def test_a_bomb_is_refused_before_it_fills_memory(name: str, tmp_path: Path) -> None:
    zeros = bytes(20 << 20)
    (tmp_path / name).write_bytes(gzip.compress(zeros) if name.endswith("gz") else zipped({"a.ply": zeros}))
    with memory_limit(10 << 20), pytest.raises(MemoryLimit):
        load(tmp_path / name)


def test_a_bomb_that_lies_about_its_size_is_refused_on_its_way(tmp_path: Path) -> None:
    (tmp_path / "a.ply").write_bytes(gzip.compress(bytes(20 << 20))[:-4] + bytes(4))
    with memory_limit(10 << 20), pytest.raises(MemoryLimit):
        load(tmp_path / "a.ply")
    with memory_limit(1 << 30), pytest.raises(InvalidFile, match="gzip is damaged"):
        load(tmp_path / "a.ply")


def test_every_cut_of_a_wrapped_file_is_one_error(tmp_path: Path) -> None:
    for data in (gzip.compress(PLY), zipped({"a.ply": PLY})):
        for size in range(4, len(data), 29):
            (tmp_path / "a.ply").write_bytes(data[:size])
            with pytest.raises(NerfbakeError):
                load(tmp_path / "a.ply")
