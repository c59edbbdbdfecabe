from __future__ import annotations

import tracemalloc
import zipfile
from pathlib import Path

import numpy as np

from nerfbake.formats.wire.zip_reader import MAX_DIRECTORY
from nerfbake.io import digests
from nerfbake.io.digests import decoded_bytes


def test_what_is_unpacked_counts(tmp_path: Path) -> None:
    np.savez_compressed(tmp_path / "a.npz", a=np.zeros(1 << 16), b=np.zeros(8, np.uint8))
    (tmp_path / "plain.svo").write_bytes(b"12345")
    assert 8 << 16 < decoded_bytes(tmp_path / "a.npz") - 8 < (8 << 16) + 512
    assert decoded_bytes(tmp_path / "plain.svo") == 5
    assert decoded_bytes(tmp_path) == 5 + (tmp_path / "a.npz").stat().st_size
    assert decoded_bytes(tmp_path / "none.npz") == 0


def test_a_broken_archive_counts_as_it_stands(tmp_path: Path) -> None:
    (tmp_path / "cut.npz").write_bytes(b"PK\x03\x04 and no more")
    assert decoded_bytes(tmp_path / "cut.npz") == 16


def test_a_directory_of_very_many_members_is_not_listed(tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "many.npz", "w") as archive:
        for number in range(20_000):
            archive.writestr(f"{number:032}", b"")
    assert digests._MAX_DIRECTORY == MAX_DIRECTORY
    tracemalloc.start()
    assert decoded_bytes(tmp_path / "many.npz") == (tmp_path / "many.npz").stat().st_size
    assert tracemalloc.get_traced_memory()[1] < 1 << 20
    tracemalloc.stop()
