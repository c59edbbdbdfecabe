"""How files that share an ending are told apart by what they hold, whatever they claim."""

from __future__ import annotations

import io
import struct
import sys
import time
import tracemalloc
import types
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import cast

import numpy as np
import pytest

from nerfbake import build_octree, catalog, load, save
from nerfbake.formats.wire.zip_reader import MAX_MEMBERS, npz_keys
from nerfbake.scene.n3tree import N3Tree
from nerfbake.scene.octree import SparseVoxelOctree
from tests.support.scenes import n3tree

READ = [form for form in catalog.FORMATS if form.readable]


def archive(names: list[str], *, comment: bytes = b"", zip64: bool = False) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as made:
        for name in names:
            with made.open(f"{name}.npy", "w", force_zip64=zip64) as member:
                member.write(b"x")
        made.comment = comment
    return file.getvalue()


def test_an_archives_names_are_its_directorys() -> None:
    names = ["a", "links", "svo_version"]
    assert npz_keys(memoryview(archive(names))) == set(names)
    assert npz_keys(memoryview(archive(names, comment=b"PK" * 1000))) == set(names)
    assert npz_keys(memoryview(archive(names)[:-30])) == {"a"}  # cut short
    assert npz_keys(memoryview(archive([]))) == set()
    assert npz_keys(memoryview(b"no archive")) == set()


def test_the_names_of_a_huge_archive_are_found(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(zipfile, "ZIP64_LIMIT", 10)  # so that a small one is written as one above 4 GiB
    monkeypatch.setattr(zipfile, "ZIP_FILECOUNT_LIMIT", 1)
    data = archive(["a", "b"], zip64=True)
    assert b"PK\6\6" in data
    assert npz_keys(memoryview(data)) == {"a", "b"}


def lies(data: bytes) -> Iterator[bytes]:
    """Archives that claim what is not so."""
    end = data.rindex(b"PK\5\6")
    for at, size in ((8, 2), (10, 2), (12, 4), (16, 4), (20, 2)):
        for value in (b"\0", b"\1", b"\x7f", b"\xff"):
            yield data[: end + at] + (value * size) + data[end + at + size :]
    first = data.index(b"PK\1\2")
    for at in (28, 30, 32):
        yield data[: first + at] + b"\xff\xff" + data[first + at + 2 :]
    yield data + b"PK\5\6"
    yield data[:4]
    yield b"PK\3\4" + b"\xff" * 200
    wide = struct.pack("<4sQ2H2I4Q", b"PK\6\6", 44, 45, 45, 0, 0, 1, 1, 2**63, 2**63)
    yield b"PK\3\4" + wide + struct.pack("<4sIQI", b"PK\6\7", 0, 4, 1) + data[end:]


def test_lying_archives_are_recognised_or_not_without_an_error() -> None:
    for lie in lies(archive(["a", "b"])):
        for form in READ:
            assert form.load_module().recognise(memoryview(lie)) in (True, False)


def test_recognising_takes_next_to_no_time_and_memory() -> None:
    """An archive whose directory is 60 MB of names, and noise of that size."""
    entry = struct.pack("<4s6H3I5H2I", b"PK\1\2", *[0] * 9, 5, *[0] * 4, 0, 0) + b"links"
    directory = entry * (60_000_000 // len(entry))
    end = struct.pack("<4s4H2IH", b"PK\5\6", 0, 0, 0xFFFF, 0xFFFF, len(directory), 0, 0)
    for data in (b"PK\3\4" + directory + end, b"{" + b" " * 60_000_000):
        modules = [form.load_module() for form in READ]
        tracemalloc.start()
        start = time.perf_counter()
        for module in modules:
            module.recognise(memoryview(data))
        assert time.perf_counter() - start < 5
        assert tracemalloc.get_traced_memory()[1] < 8 << 20
        tracemalloc.stop()
    names = [f"{k:09}" for k in range(MAX_MEMBERS + 10)]
    assert len(npz_keys(memoryview(archive(names)))) == MAX_MEMBERS


class Checkpoint:
    """Another program's checkpoint, an .npz as well: a format of two functions."""

    @staticmethod
    def recognise(view: memoryview) -> bool:
        return "toy" in npz_keys(view)

    @staticmethod
    def decode(view: memoryview) -> SparseVoxelOctree:
        return build_octree(n3tree())


@pytest.mark.parametrize("before", [True, False])
def test_two_kinds_of_npz_are_told_apart_by_what_they_hold(
    before: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whichever line stands first, whatever stands first in the archive, with its ending, another, or none."""
    toy = catalog.Format("toy", "SparseVoxelOctree", ".npz", "toy", "a toy")
    lines = list(catalog.FORMATS)
    lines.insert(next(i for i, form in enumerate(lines) if form.name == "npz") + (not before), toy)
    monkeypatch.setattr(catalog, "FORMATS", tuple(lines))
    monkeypatch.setitem(sys.modules, "nerfbake.formats.toy", cast(types.ModuleType, Checkpoint))
    save(tmp_path / "tree.npz", n3tree())
    np.savez(tmp_path / "made.npz", values=np.zeros(1000), toy=np.zeros(3))
    for ending in (".npz", ".bin"):
        for name, kind in (("tree", N3Tree), ("made", SparseVoxelOctree)):
            path = tmp_path / f"{name}{ending}"
            path.write_bytes((tmp_path / f"{name}.npz").read_bytes())
            assert isinstance(load(path), kind)
