"""`nerfbake lod` as a shell sees it."""

from __future__ import annotations

from pathlib import Path

import pytest

from nerfbake import SparseVoxelOctree, load
from nerfbake.cli.main import run


@pytest.mark.usefixtures("tree_file")
def test_a_level_and_its_budget(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert run(["svo", "a.npz", "a.svo.pb", "-q"]) == 0
    assert run(["lod", "a.svo.pb", "b.svo.pb", "--level", "1", "-q"]) == 0
    assert load("b.svo.pb", SparseVoxelOctree).level_sizes == [1, 8]
    assert run(["lod", "a.svo.pb", "c.svo.pb", "--level", "0", "--min-psnr", "50", "-q"]) == 3
    assert capsys.readouterr().err.startswith("error: c.svo.pb: the picture has a mean PSNR of ")
    assert not Path("c.svo.pb").exists()
    assert load("c.svo.pb.rejected", SparseVoxelOctree).level_sizes == [1]
    assert run(["lod", "a.svo.pb", "d.svo.pb", "--level", "9"]) == 1
    assert capsys.readouterr().err == "error: a.svo.pb: level is 9; allowed: 0 to 2, the level of single voxels\n"
