"""Octrees and volumes cut off and with flipped bits: exit 0 or 1, one line, soon, in little memory, nothing left."""

from __future__ import annotations

import json
import subprocess
import sys
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import pytest

from nerfbake import build_octree, build_vdb, save
from tests.conftest import REPOSITORY
from tests.support.n3trees import archive, svox
from tests.support.octrees import SPELLINGS
from tests.support.scenes import n3tree
from tests.support.vdb_readers import blosc_for_zip, bloscked

DAMAGED: list[tuple[str, str, str | None]] = [("svo", "npz", None), ("svo", "stored.npz", None)]
DAMAGED += [("convert", name, profile) for name, profile in SPELLINGS]
DAMAGED += [("convert", "svo.pb.zst", "report"), ("convert", "svo.npz.zst", None)]
DAMAGED += [("convert", suffix, None) for suffix in ("vdb", "nvdb", "zip.nvdb", "vdb.npz", "blosc.vdb", "blosc.nvdb")]


@pytest.mark.long
@pytest.mark.parametrize(("command", "suffix", "profile"), DAMAGED)
def test_damaged_files(command: str, suffix: str, profile: str | None, tmp_path: Path) -> None:
    """Cut at every 1 %, and 300 bit flips: exit 0 or 1, one line, under 5 s, under 3 GiB, nothing left behind."""
    tree = n3tree(splits=[(0, (0, 0, 0)), (0, (1, 0, 1)), (1, (1, 1, 1))], data_format="SH4")
    source = tmp_path / f"good.{suffix}"
    if command == "svo":
        source.write_bytes(archive(svox(tree), deflated=suffix == "npz"))
    elif "vdb" in suffix:
        grids = ("index",) if "nvdb" in suffix else ("density", "sh")
        codec: Any = {"codec": "zip"} if suffix == "zip.nvdb" else {}
        with blosc_for_zip() if suffix == "blosc.vdb" else nullcontext():
            save(source, build_vdb(build_octree(tree), grids=grids), **codec)
        if suffix == "blosc.nvdb":
            source.write_bytes(bloscked(source.read_bytes()))
    else:
        options: Any = {"profile": profile} if profile else {}
        save(source, build_octree(tree), **options)
    arguments = [sys.executable, "-m", "tests.support.hostile", command, str(source), "300"]
    done = subprocess.run(arguments, cwd=REPOSITORY, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout) == []
    assert sorted(path.name for path in tmp_path.iterdir()) == [f"bad.{suffix}", source.name]
