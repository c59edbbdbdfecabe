"""NanoVDB files whose fields lie: read, or refused in one line."""

from __future__ import annotations

from pathlib import Path

import pytest

from nerfbake import save
from nerfbake.formats.wire import nanovdb as nano
from nerfbake.io import check
from tests.support.hostile import complaint
from tests.support.vdb_readers import SCENES, index, tree, volume

START = nano.FILE.itemsize + nano.META.itemsize + len(b"density\0")
STRUCTS = {
    "FILE": (nano.FILE, 0),
    "META": (nano.META, nano.FILE.itemsize),
    "GRID": (nano.GRID, START),
    "TREE": (nano.TREE, START + 672),
    "ROOT": (nano.FLOAT.root, START + 736),
    "TILE": (nano.FLOAT.tile, START + 800),
    "UPPER": (nano.FLOAT.upper, START + 832),
    "LOWER": (nano.FLOAT.lower, START + 832 + 270400),
    "LEAF": (nano.FLOAT.leaf, START + 832 + 270400 + 33856),
}
FIELDS = [(name, field) for name, (dtype, _) in STRUCTS.items() for field in dtype.names or ()]


@pytest.mark.parametrize(("name", "field"), FIELDS)
def test_a_lying_nanovdb_is_read_or_refused_in_one_line(name: str, field: str, tmp_path: Path) -> None:
    """Every field of every struct, its bytes all ones, all zeros, a small and a large number; no checksum helps."""
    save(tmp_path / "good.nvdb", volume(tree(SCENES["a full leaf"])))
    good = bytearray((tmp_path / "good.nvdb").read_bytes())
    good[START + 8 : START + 16] = b"\xff" * 8
    dtype, start = STRUCTS[name]
    fields = dtype.fields
    assert fields is not None
    kind, offset = fields[field][:2]
    size = min(kind.itemsize, 64)
    for lie in (b"\xff" * size, bytes(size), b"\1".ljust(size, b"\0"), (b"\xff" * (size - 1) + b"\x7f")):
        broken = bytearray(good)
        broken[start + offset : start + offset + size] = lie
        (tmp_path / "bad.nvdb").write_bytes(broken)
        assert complaint(["info", str(tmp_path / "bad.nvdb")], None) is None, lie
        assert all(problem.line for problem in check(tmp_path / "bad.nvdb"))


@pytest.mark.parametrize("field", nano.BLIND.names or ())
def test_lying_blind_data_are_refused_in_one_line(field: str, tmp_path: Path) -> None:
    made = volume(index(SCENES["a full leaf"]))
    save(tmp_path / "good.nvdb", made)
    good = bytearray((tmp_path / "good.nvdb").read_bytes())
    start = len(good) - 513 * 16 - (-513 * 16) % 32 - nano.BLIND.itemsize
    assert good[start + 32 : start + 37] == b"M_vdb"
    fields = nano.BLIND.fields
    assert fields is not None
    kind, offset = fields[field][:2]
    for lie in (b"\xff" * kind.itemsize, bytes(kind.itemsize)):
        broken = bytearray(good)
        broken[start + offset : start + offset + kind.itemsize] = lie
        (tmp_path / "bad.nvdb").write_bytes(broken)
        assert complaint(["info", str(tmp_path / "bad.nvdb")], None) is None
