"""`nerfbake svo` as a shell sees it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import nerfbake
from nerfbake import N3Tree, SparseVoxelOctree, load
from nerfbake.cli.main import run
from tests.conftest import Shell
from tests.support.scenes import assert_same_octree
from tests.support.splats import ball_of_splats


@pytest.mark.usefixtures("tree_file")
def test_options_of_svo(shell: Shell, tmp_path: Path) -> None:
    options = [
        "--resolution",
        "5x4X3",
        "--resample",
        "nearest",
        "--dtype",
        "float16",
        "--no-child=-1",
        "--sigma-min",
        "0",
    ]
    assert shell("svo", "a.npz", "b.svo.npz", *options).returncode == 0
    with np.load(tmp_path / "b.svo.npz") as npz:
        assert npz["size"].tolist() == [5, 4, 3]
        assert npz["node_data"].dtype == np.float16
        assert npz["node_children"].min() == -1
    expected = nerfbake.build_octree(
        load(tmp_path / "a.npz"), resolution=(5, 4, 3), resample="nearest", dtype="float16", sigma_min=0
    )
    assert_same_octree(load(tmp_path / "b.svo.npz", SparseVoxelOctree), expected)


@pytest.mark.usefixtures("tree_file")
@pytest.mark.parametrize(
    ("arguments", "code", "said"),
    [
        (["svo", "nope.npz", "b.svo.pb"], 1, "nope.npz: No such file or directory"),
        (["svo", ".", "b.svo.pb"], 1, ".: is a folder of unknown kind"),
        (["svo", "a.npz", "nowhere/b.svo.pb"], 4, "nowhere/b.svo.pb: its folder nowhere does not exist; allowed: an"),
        (["svo", "a.npz", "a.npz"], 2, "'a.npz' has no file extension for an octree; allowed: .svo.npz"),
        (["svo", "a.npz", "-"], 2, "stdout has no file extension; allowed: --to FORMAT"),
        (["svo", "a.npz", "b.svo.pb", "--to", "obj"], 2, "an octree cannot be written as 'obj'"),
        (["svo", "a.npz"], 2, "Missing argument 'OUT'"),
        (["svo", "a.npz", "b.svo.pb", "--resolutoin", "4"], 2, "No such option"),
        (["svo", "a.npz", "b.svo.pb", "--resolution", "4x4"], 2, "'4x4' is not a resolution; allowed: R or WxHxD"),
        (["svo", "a.npz", "b.svo.pb", "--resolution", "4097"], 2, "'4097' is not a resolution"),
        (["svo", "a.npz", "b.svo.pb", "--sigma-min", "nan"], 2, "'--sigma-min': NaN is not allowed; allowed: a number"),
        (["svo", "a.npz", "b.svo.pb", "--box", "outer"], 2, "'outer' is not a box; allowed: x0,y0,z0,x1,y1,z1"),
        (["svo", "a.npz", "b.svo.pb", "--box=0,0,0,1,1,1"], 2, "--box of six numbers has no effect on a PlenOctree"),
        (
            ["svo", "a.npz", "b.svo.pb", "--in-up", "y"],
            2,
            "--in-up has no effect on a PlenOctree; allowed: with splats",
        ),
        (["svo", "a.npz", "b.svo.pb", "--max-memory", "many"], 2, "'many' is not a size; allowed: 4GiB"),
        (["svo", "a.npz", "b.svo.pb", "--max-memory", "100"], 1, "B; allowed: 100 B (--max-memory)"),
    ],
)
def test_what_goes_wrong_is_one_line(shell: Shell, tmp_path: Path, arguments: list[str], code: int, said: str) -> None:
    before = sorted(tmp_path.iterdir())
    done = shell(*arguments)
    (line,) = done.stderr.decode().splitlines()
    assert line.startswith("error: ")
    assert said in line
    assert (done.returncode, done.stdout) == (code, b"")
    assert sorted(tmp_path.iterdir()) == before


@pytest.mark.usefixtures("tree_file")
def test_an_existing_output_is_found_before_the_work(shell: Shell, tmp_path: Path) -> None:
    (tmp_path / "b.svo.pb").write_bytes(b"old")
    done = shell("svo", "a.npz", "b.svo.pb", "-v")
    assert (done.returncode, done.stderr) == (4, b"error: b.svo.pb: exists already; allowed: a new file, or --force\n")
    assert (tmp_path / "b.svo.pb").read_bytes() == b"old"
    assert shell("svo", "a.npz", "b.svo.pb", "--force").returncode == 0


@pytest.mark.usefixtures("tree_file")
def test_a_budget_that_holds_and_one_that_does_not(shell: Shell, tmp_path: Path) -> None:
    assert shell("svo", "a.npz", "good.svo.pb", "--min-psnr", "50").returncode == 0
    assert (tmp_path / "good.svo.pb").exists()
    done = shell("svo", "a.npz", "bad.svo.pb", "--resolution", "1", "--min-psnr", "50")
    assert done.returncode == 3
    assert done.stderr.decode().splitlines()[-1].startswith("error: bad.svo.pb: the picture has a mean PSNR of ")
    assert not (tmp_path / "bad.svo.pb").exists()
    assert load(tmp_path / "bad.svo.pb.rejected", SparseVoxelOctree).problems() == []
    assert shell("svo", "a.npz", "-", "--to", "svo.pb", "--min-psnr", "50").returncode == 2


def test_a_plenoctree_may_be_compressed_too(tmp_path: Path) -> None:
    assert run(["sample", "octree", str(tmp_path / "a.npz.zst"), "--resolution", "8", "-q"]) == 0
    (tmp_path / "a_poses_bounds.npy").touch()
    assert load(tmp_path / "a.npz.zst", N3Tree).ndc
    assert run(["svo", str(tmp_path / "a.npz.zst"), str(tmp_path / "a.svo.pb"), "-q"]) == 1  # it faces forward


def test_options_of_splats(shell: Shell, tmp_path: Path) -> None:
    nerfbake.save(tmp_path / "a.ply", ball_of_splats())
    options = ["--resolution", "16", "--box=-2,-2,0,2,2,2", "--opacity-min", "0.5", "--in-up=-y", "--epochs", "0"]
    done = shell("svo", "a.ply", "b.svo.npz", *options)
    assert done.returncode == 0
    octree = load(tmp_path / "b.svo.npz", SparseVoxelOctree)
    assert (octree.size, octree.origin.tolist()) == ((16, 16, 8), [-2, -2, 0])
    [cut, lost, wrote] = done.stderr.decode().splitlines()
    assert cut.startswith("a.ply: leaves out 1")
    assert cut.endswith(" of 400 outside the box -2,-2,0,2,2,2")
    assert lost.startswith("a.ply: in 16x16x8 voxels, ")
    assert wrote.startswith("b.svo.npz: SH1 octree of 16x16x8")
