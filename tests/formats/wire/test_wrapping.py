"""Files taken out of gzip and of zip archives."""

from __future__ import annotations

import gzip
import io
import zipfile

import pytest

from nerfbake.errors import InvalidFile
from nerfbake.formats.wire.deflate import gunzip
from nerfbake.formats.wire.wrapping import is_gzip, unwrap_gzip, unwrap_zip

ENDINGS = ((".ply", ".obj"), (".png",))


def zipped(*names: str) -> memoryview:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        for name in names:
            archive.writestr(name, name)
    return memoryview(file.getvalue())


def test_a_name_loses_its_ending() -> None:
    data = memoryview(gzip.compress(b"hello"))
    assert is_gzip(data)
    assert [unwrap_gzip(data, name).name for name in ("a.ply.gz", "a.GZ", "a.ply", "")] == ["a.ply", "a", "a.ply", ""]
    assert bytes(unwrap_gzip(data, "").view) == b"hello"


def test_a_scene_counts_before_a_picture() -> None:
    found = unwrap_zip(zipped("x/a.png", "x/a.OBJ", "b.png", "x/y/c.txt"), ENDINGS)
    assert found is not None
    assert (found.name, bytes(found.view)) == ("a.OBJ", b"x/a.OBJ")
    assert found.beside is not None
    assert list(found.beside) == ["a.png", "a.OBJ", "y/c.txt"]
    alone = unwrap_zip(zipped("x/a.png", "c.txt"), ENDINGS)
    assert alone is not None
    assert alone.name == "a.png"


def test_what_holds_no_scene_is_no_wrapping() -> None:
    assert unwrap_zip(zipped("a.txt"), ENDINGS) is None
    assert unwrap_zip(memoryview(b"ply\n"), ENDINGS) is None


def test_one_of_several_scenes_is_not_chosen() -> None:
    with pytest.raises(InvalidFile, match=r"the archive has 2 scenes: a\.ply, x/b\.ply; allowed: one scene"):
        unwrap_zip(zipped("x/b.ply", "a.ply", "__MACOSX/c.ply"), ENDINGS)


def test_an_archive_with_an_empty_directory_is_refused() -> None:
    """The scene is found by the header in front of it, but the directory does not list it."""
    data = bytes(zipped("a.ply"))
    with pytest.raises(InvalidFile, match=r"zip directory does not list a\.ply; allowed: a complete zip archive"):
        unwrap_zip(memoryview(data[:-22] + b"PK\5\6" + bytes(18)), ENDINGS)


@pytest.mark.parametrize("size", [0, 1, 1 << 14, (1 << 20) + 1])
def test_gzip_is_read_whole(size: int) -> None:
    content = bytes(range(256)) * (size // 256) + bytes(size % 256)
    data = gzip.compress(content[: size // 2]) + gzip.compress(content[size // 2 :])
    assert bytes(gunzip(memoryview(data), "a")) == content
    assert bytes(gunzip(memoryview(data + bytes(9)), "a", most=size)) == content
    if size:
        with pytest.raises(InvalidFile, match="a continues after"):
            gunzip(memoryview(data), "a", most=size - 1)


def test_every_change_of_a_byte_of_gzip_is_found() -> None:
    data = gzip.compress(b"hello, hello, hello", mtime=0)
    for at in (*range(4), *range(10, len(data))):
        changed = bytearray(data)
        changed[at] ^= 0x40
        with pytest.raises(InvalidFile):
            gunzip(memoryview(changed), "a")
    with pytest.raises(InvalidFile, match="a is cut off after 0 bytes"):
        gunzip(memoryview(b""), "a")
