"""`nerfbake compare`, and budgets right after writing, as a shell sees them."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from nerfbake import N3Tree, SparseVoxelOctree, load, orbit, save
from tests.conftest import Shell
from tests.scenes import n3tree


@pytest.fixture
def tree_file(tmp_path: Path) -> Path:
    save(tmp_path / "a.npz", n3tree(splits=[(0, (1, 0, 1))], data_format="SH4"))
    return tmp_path / "a.npz"


@pytest.mark.usefixtures("tree_file")
def test_a_budget_that_holds_and_one_that_does_not(shell: Shell, tmp_path: Path) -> None:
    assert shell("svo", "a.npz", "good.svo.pb", "--min-psnr", "50").returncode == 0
    assert (tmp_path / "good.svo.pb").exists()
    done = shell("svo", "a.npz", "bad.svo.pb", "--resolution", "1", "--min-psnr", "50")
    assert done.returncode == 3
    assert done.stderr.decode().splitlines()[-1].startswith("error: bad.svo.pb: the picture has a mean PSNR of ")
    assert not (tmp_path / "bad.svo.pb").exists()
    assert load(tmp_path / "bad.svo.pb.rejected", SparseVoxelOctree).problems() == []
    assert shell("lod", "good.svo.pb", "l.svo.pb", "--level", "0", "--min-psnr", "50").returncode == 3
    assert (tmp_path / "l.svo.pb.rejected").exists()
    assert shell("svo", "a.npz", "-", "--to", "svo.pb", "--min-psnr", "50").returncode == 2


@pytest.mark.usefixtures("tree_file")
def test_volumes_have_budgets_too(shell: Shell, tmp_path: Path) -> None:
    save(tmp_path / "c.json", orbit(load(tmp_path / "a.npz", N3Tree), frames=2, width=24, height=20))
    budget = ["--cameras", "c.json", "--min-psnr", "50"]
    assert shell("vdb", "a.npz", "good.nvdb", "--grids", "index", *budget).returncode == 0
    assert shell("compare", "a.npz", "good.nvdb", "--cameras", "c.json", "--min-psnr", "60").returncode == 0
    assert shell("vdb", "a.npz", "grey.vdb", "--grids", "density", *budget).returncode == 3
    assert sorted(path.name for path in tmp_path.glob("*vdb*")) == ["good.nvdb", "grey.vdb.rejected"]
    done = shell("vdb", "a.npz", "y.vdb", "--up", "y", *budget)
    assert (done.returncode, done.stderr.count(b"allowed: --up z")) == (2, 1)


@pytest.mark.usefixtures("tree_file")
def test_compare(shell: Shell, tmp_path: Path) -> None:
    assert shell("svo", "a.npz", "b.svo.pb", "--resolution", "2").returncode == 0
    done = shell("compare", "a.npz", "b.svo.pb", "--size", "40x30", "--sheet", "sheet.png", "--json")
    assert done.returncode == 0, done.stderr
    told = json.loads(done.stdout)
    assert len(told["views"]) == 8
    assert 5 < told["mean"]["a_b"]["psnr"] < 60
    assert (tmp_path / "sheet.png").stat().st_size > 100
    done = shell("compare", "a.npz", "b.svo.pb", "--size", "40x30", "--max-error", "0")
    assert done.returncode == 3
    assert done.stdout.decode().splitlines()[-4].startswith("mean        IN - IN2")
    assert "b.svo.pb: the picture is off by" in done.stderr.decode()


@pytest.mark.usefixtures("tree_file")
def test_truth_from_a_folder(shell: Shell, tmp_path: Path) -> None:
    tree = load(tmp_path / "a.npz", N3Tree)
    save(tmp_path / "cameras.json", orbit(tree, frames=2, width=24, height=20))
    assert shell("render", "a.npz", "--cameras", "cameras.json", "--all", "--out", "truth").returncode == 0
    done = shell("compare", "a.npz", "a.npz", "--cameras", "cameras.json", "--truth", "truth", "--json")
    told = json.loads(done.stdout)
    assert told["mean"]["a_b"]["psnr"] == 100
    assert told["mean"]["a_truth"]["psnr"] > 50  # but for the rounding to 8 bits
    (tmp_path / "truth" / "0001.png").unlink()
    done = shell("compare", "a.npz", "a.npz", "--cameras", "cameras.json", "--truth", "truth")
    assert (done.returncode, done.stderr) == (1, b"error: truth/0001.png: No such file or directory\n")
