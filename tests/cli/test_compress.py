"""`nerfbake compress`, as a shell sees it."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from nerfbake import Cameras, SparseVoxelOctree, build_field, build_octree, load, orbit_cameras, render_field, save
from nerfbake import sample_n3tree as made_tree
from nerfbake.jobs import CompressionGoal, compress_file
from tests.conftest import Shell
from tests.support.scenes import n3tree

pytestmark = pytest.mark.usefixtures("fewer_rays")


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    save(tmp_path / "a.npz", made_tree(resolution=8, basis="SH4"))
    return tmp_path / "a.npz"


@pytest.mark.usefixtures("scene")
def test_a_tree_and_its_octree_are_the_same_file(shell: Shell, tmp_path: Path) -> None:
    done = shell("compress", "a.npz", "a.svoq", "--json")
    assert done.returncode == 0, done.stderr
    told = json.loads(done.stdout)
    assert told["size"] == (tmp_path / "a.svoq").stat().st_size
    assert 0.08 <= told["loss"] <= 0.1
    assert not told["measured"]
    assert 0 < told["expected"] < told["loss"]
    line = f"{told['loss']:.3f} dB at most ({told['expected']:.3f} dB expected), predicted on 24 views"
    assert f"{line} of a source of 30.50 dB" in done.stderr.decode()
    assert shell("svo", "a.npz", "a.svo.pb").returncode == 0
    assert shell("compress", "a.svo.pb", "b.svoq").returncode == 0
    assert (tmp_path / "a.svoq").read_bytes() == (tmp_path / "b.svoq").read_bytes()


@pytest.mark.long
@pytest.mark.usefixtures("scene")
def test_everything_that_reads_an_octree_reads_it(shell: Shell, tmp_path: Path) -> None:
    assert shell("compress", "a.npz", "a.svoq", "--step", "0.02").returncode == 0
    assert b"SH4" in shell("info", "a.svoq").stdout
    assert shell("check", "a.svoq").returncode == 0
    assert shell("render", "a.svoq", "--out", "a.png", "--size", "20x20").returncode == 0
    assert shell("compare", "a.npz", "a.svoq", "--size", "40x40", "--min-psnr", "40").returncode == 0
    assert shell("convert", "a.svoq", "b.svo.pb").returncode == 0
    assert shell("lod", "a.svoq", "c.svo.npz", "--level", "2").returncode == 0
    assert shell("vdb", "a.svoq", "d.nvdb").returncode == 0
    # What a file stands for is the same octree each time.
    assert load(tmp_path / "b.svo.pb", SparseVoxelOctree).problems() == []


@pytest.mark.long
@pytest.mark.usefixtures("scene")
def test_a_size_is_a_promise(shell: Shell, tmp_path: Path) -> None:
    assert shell("compress", "a.npz", "a.svoq", "--max-size", "900").returncode == 0
    assert 855 <= (tmp_path / "a.svoq").stat().st_size <= 900
    assert shell("compress", "a.npz", "c.svoq", "--max-size", "900", "--coding", "deflate").returncode == 0
    assert 855 <= (tmp_path / "c.svoq").stat().st_size <= 900
    done = shell("compress", "a.npz", "b.svoq", "--max-size", "100")
    assert done.returncode == 3
    assert b"error: a.npz: the octree takes" in done.stderr
    assert not (tmp_path / "b.svoq").exists()


@pytest.mark.usefixtures("scene")
def test_a_loss_is_measured_against_photographs(shell: Shell, tmp_path: Path) -> None:
    field = build_field(build_octree(load(tmp_path / "a.npz")))
    cameras = orbit_cameras(field, frames=3, width=30, height=20)
    other = build_field(build_octree(load(tmp_path / "a.npz"), resolution=4))
    for camera in cameras.cameras:
        save(tmp_path / f"{camera.name}.png", render_field(other, camera))
    save(tmp_path / "c.json", Cameras(cameras.cameras))
    done = shell("compress", "a.npz", "a.svoq", "--cameras", "c.json", "--truth", ".", "--max-loss", "0.5", "--json")
    assert done.returncode == 0, done.stderr
    told = json.loads(done.stdout)
    assert told["measured"]
    assert told["views"] == 3
    assert told["source_psnr"] < 35
    assert "dB measured on 3 views of a source of " in done.stderr.decode()
    assert told["loss"] == told["expected"] <= 0.5


@pytest.mark.usefixtures("scene")
def test_what_cannot_be_asked_for(shell: Shell) -> None:
    for options, line in (
        (["--max-loss", "1", "--step", "1"], "--max-loss and --step are two goals; allowed: one of"),
        (["--truth", "."], "--truth has no cameras; allowed: --truth with --cameras"),
        (["--cameras", "c.json"], "--cameras has no effect without --truth or --min-psnr"),
        (["--cameras", "c.json", "--truth", ".", "--source-psnr", "30"], "--source-psnr has no effect with --truth"),
    ):
        done = shell("compress", "a.npz", "a.svoq", *options)
        assert done.returncode == 2
        assert line in done.stderr.decode()
    assert shell("compress", "a.npz", "a.svo.pb").returncode == 2
    done = shell("compress", "a.npz", "a.svoq", "--basis", "SH9")
    assert done.returncode == 1
    assert "the basis is SH9 for an octree of SH4; allowed: SH1" in done.stderr.decode()


def test_what_has_no_spherical_harmonics_is_refused(shell: Shell, tmp_path: Path) -> None:
    save(tmp_path / "a.npz", n3tree(data_format="SG2"))
    done = shell("compress", "a.npz", "a.svoq")
    assert done.returncode == 1
    assert done.stderr.decode().splitlines() == [
        "error: a.npz: data_format is SG2; allowed: SHk or RGBA can be rendered"
    ]


@pytest.mark.long
@pytest.mark.usefixtures("scene")
def test_a_budget_moves_what_is_not_good_enough(shell: Shell, tmp_path: Path) -> None:
    assert shell("compress", "a.npz", "a.svoq", "--step", "2", "--min-psnr", "60").returncode == 3
    assert not (tmp_path / "a.svoq").exists()
    assert (tmp_path / "a.svoq.rejected").exists()


def test_the_job_is_the_command(scene: Path, tmp_path: Path) -> None:
    found = compress_file(scene, tmp_path / "a.svoq", goal=CompressionGoal(max_loss=0.2))
    assert found.size == (tmp_path / "a.svoq").stat().st_size
    assert found.loss <= 0.2
