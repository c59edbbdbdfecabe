"""`nerfbake bench`: what it refuses."""

from __future__ import annotations

from pathlib import Path

import pytest

from nerfbake import build_octree, build_vdb, sample_n3tree, save
from nerfbake.cli.main import run
from tests.support.lattices import svox2_file


@pytest.mark.parametrize("command", ["formats", "access", "compress"])
def test_scenes_that_are_not_measured_are_named(
    command: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    save("a.vdb", build_vdb(build_octree(sample_n3tree(resolution=8))))
    Path("lattice.npz").write_bytes(svox2_file())
    for name, kind in (("a.vdb", "a volume"), ("lattice.npz", "a lattice field")):
        assert run(["bench", command, name]) == 1
        assert f"error: {name}: holds {kind}" in capsys.readouterr().err
