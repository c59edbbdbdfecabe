"""`nerfbake convert` as a shell sees it: formats, profiles, compression, pipes."""

from __future__ import annotations

import io
import json
from pathlib import Path

import click
import numpy as np
import pytest
import zstandard

from nerfbake import Cameras, Splats, load, save
from nerfbake.cli.convert import convert
from nerfbake.cli.main import run
from nerfbake.cli.paths import declared
from nerfbake.scene.octree import SparseVoxelOctree
from tests.conftest import Shell
from tests.support.camera_tools import write_metashape
from tests.support.captures import rig
from tests.support.octrees import FORMATS, small_octree
from tests.support.scenes import assert_same_octree, n3tree
from tests.support.splats import splats
from tests.support.vdb_readers import tree, volume


@pytest.mark.usefixtures("tree_file")
def test_a_pipeline(shell: Shell, tmp_path: Path) -> None:
    first = shell("svo", "a.npz", "-", "--to", "svo.pb", "--layout", "compact")
    assert (first.returncode, first.stderr.count(b"\n")) == (0, 1)
    second = shell("convert", "-", "-", "--to", "svo.npz", "-q", stdin=first.stdout)
    assert (second.returncode, second.stderr) == (0, b"")
    third = shell("lod", "-", "b.svo.pb", "--level", "1", stdin=second.stdout)
    assert third.returncode == 0
    assert third.stdout == b""
    octree = load(tmp_path / "b.svo.pb", SparseVoxelOctree)
    assert (octree.size, octree.layout, octree.level_sizes) == ((2, 2, 2), "compact", [1, 8])
    told = json.loads(shell("info", "-", "--json", stdin=second.stdout).stdout)
    assert (told["format"], told["nodes_per_level"]) == ("svo.npz", [1, 8, 8])
    with np.load(io.BytesIO(second.stdout)) as npz:
        assert npz["size"].tolist() == [4, 4, 4]


@pytest.mark.parametrize("suffix", ["", ".zst"])
def test_every_format_goes_through_a_pipe(suffix: str, shell: Shell, tmp_path: Path) -> None:
    octree, name = small_octree(), ""
    save(tmp_path / "a.svo.npz", octree)
    stream = (tmp_path / "a.svo.npz").read_bytes()
    for name in FORMATS:
        done = shell("convert", "-", "-", "--to", f"{name}{suffix}", "-q", stdin=stream)
        assert (done.returncode, done.stderr) == (0, b"")
        stream = done.stdout
        assert stream.startswith(b"\x28\xb5\x2f\xfd") == bool(suffix)
        told = json.loads(shell("info", "-", "--json", stdin=stream).stdout)
        assert (told["format"], told["nodes"], told["bytes_on_disk"]) == (f"{name}{suffix}", octree.n, len(stream))
    assert shell("check", "-", stdin=stream).returncode == 0
    (tmp_path / f"b.{name}{suffix}").write_bytes(stream)
    assert_same_octree(load(tmp_path / f"b.{name}{suffix}", SparseVoxelOctree), octree)


@pytest.mark.parametrize("command", ["svo", "convert", "lod"])
def test_profiles_are_options_of_what_writes_octrees(command: str, tmp_path: Path) -> None:
    save(tmp_path / "a.npz", n3tree(splits=[(0, (1, 0, 1))], data_format="SH4"))
    save(tmp_path / "a.svo.pb", small_octree())
    source = str(tmp_path / ("a.npz" if command == "svo" else "a.svo.pb"))
    options = ["--level", "1"] if command == "lod" else []
    for profile, kind in (("report", list), ("bulk", dict)):
        target = tmp_path / f"{profile}.svo.json"
        assert run([command, source, str(target), "--profile", profile, *options, "-q"]) == 0
        assert isinstance(json.loads(target.read_text())["node_data"], kind)


@pytest.mark.parametrize("command", ["svo", "convert"])
def test_the_type_of_voxels_is_written_on_request(command: str, tmp_path: Path) -> None:
    save(tmp_path / "a.npz", n3tree(splits=[(0, (1, 0, 1))], data_format="SH4"))
    save(tmp_path / "a.svo.pb", small_octree())
    source = str(tmp_path / ("a.npz" if command == "svo" else "a.svo.pb"))
    for voxel_type, name in (("number", "google.protobuf.FloatValue"), ("struct", "svo.protobuf.SH4Voxel")):
        target = tmp_path / f"{voxel_type}.svo.json"
        assert run([command, source, str(target), "--voxel-type", voxel_type, "-q"]) == 0
        assert json.loads(target.read_text())["type_url"] == f"type.googleapis.com/{name}"


def test_the_default_of_svo_pb_is_listing_3_and_bulk_elsewhere(tmp_path: Path) -> None:
    save(tmp_path / "a.svo.npz", small_octree())
    for name, form in FORMATS.items():
        for profile in (None, *form.choices("profile")):
            options = ["--profile", profile] if profile else []
            target = tmp_path / f"{profile}.{name}"
            assert run(["convert", str(tmp_path / "a.svo.npz"), str(target), "-q", *options]) == 0
        if form.choices("profile"):
            expected = "report" if name == "svo.pb" else "bulk"
            assert (tmp_path / f"None.{name}").read_bytes() == (tmp_path / f"{expected}.{name}").read_bytes()
            assert (tmp_path / f"report.{name}").read_bytes() != (tmp_path / f"bulk.{name}").read_bytes()


def test_a_profile_of_a_format_that_has_none_is_wrong_usage(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    save(tmp_path / "a.svo.pb", small_octree())
    assert run(["convert", str(tmp_path / "a.svo.pb"), str(tmp_path / "b.svo.npz"), "--profile", "bulk"]) == 2
    assert "svo.npz takes no option 'profile'; allowed: no_child (0, -1)" in capsys.readouterr().err
    assert not (tmp_path / "b.svo.npz").exists()


def test_a_compressed_file_is_seen_whatever_its_name(tmp_path: Path) -> None:
    octree = small_octree()
    save(tmp_path / "a.svo.fb.zst", octree)
    (tmp_path / "a.svo.fb.zst").rename(tmp_path / "a.svo.fb")
    assert_same_octree(load(tmp_path / "a.svo.fb", SparseVoxelOctree), octree)


def test_what_zstd_itself_compressed_is_read(tmp_path: Path) -> None:
    octree = small_octree()
    save(tmp_path / "a.svo.pb", octree)
    packed = zstandard.ZstdCompressor(level=19).compress((tmp_path / "a.svo.pb").read_bytes())
    (tmp_path / "b.svo.pb.zst").write_bytes(packed)
    assert_same_octree(load(tmp_path / "b.svo.pb.zst", SparseVoxelOctree), octree)


def test_a_file_that_is_not_compressed_although_it_says_so_is_read_by_its_content(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    save(tmp_path / "a.svo.pb", small_octree())
    (tmp_path / "a.svo.pb").rename(tmp_path / "a.svo.pb.zst")
    assert_same_octree(load(tmp_path / "a.svo.pb.zst", SparseVoxelOctree), small_octree())
    (tmp_path / "b.svo.pb.zst").write_bytes(b"neither")
    assert run(["info", str(tmp_path / "b.svo.pb.zst")]) == 1
    assert "b.svo.pb.zst: starts with 6e 65" in capsys.readouterr().err


def test_same_scene_same_bytes(tmp_path: Path) -> None:
    for name in FORMATS:
        for suffix in ("", ".zst"):
            a, b = tmp_path / f"a.{name}{suffix}", tmp_path / f"b.{name}{suffix}"
            save(a, small_octree())
            save(b, small_octree())
            assert a.read_bytes() == b.read_bytes()


@pytest.mark.usefixtures("tree_file")
def test_a_plenoctree_becomes_the_octree_that_svo_makes(tmp_path: Path, shell: Shell) -> None:
    assert shell("convert", "a.npz", "b.svo.pb").returncode == 0
    assert shell("svo", "a.npz", "c.svo.pb").returncode == 0
    assert (tmp_path / "b.svo.pb").read_bytes() == (tmp_path / "c.svo.pb").read_bytes()


def test_a_nvdb_of_many_grids_says_how_to_write_each(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    save(tmp_path / "smoke.vdb", volume(tree([[0, 0, 0]], name="heat"), tree([[0, 0, 0]])))
    line = ["convert", str(tmp_path / "smoke.vdb"), str(tmp_path / "smoke.nvdb")]
    assert run(line) == 1
    said = "2 grids: heat, density; allowed: --grid NAME for one of them, or --grid all for one file per grid"
    assert said in capsys.readouterr().err
    assert run([*line, "--grid", "all"]) == 0
    assert sorted(path.name for path in tmp_path.glob("*.nvdb")) == ["smoke.density.nvdb", "smoke.heat.nvdb"]
    assert run([*line, "--grid", "all", "--layout", "full"]) == 2
    assert run([*line, "--grid", "all", "--resolution", "16"]) == 2
    assert "--layout has no effect" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["half.nvdb", "half.usda"])
def test_half_is_for_volumes_and_for_splats(name: str, tmp_path: Path) -> None:
    save(tmp_path / "smoke.vdb", volume(tree([[0, 0, 0]])))
    save(tmp_path / "a.ply", splats(3))
    source = "smoke.vdb" if name == "half.nvdb" else "a.ply"
    assert run(["convert", str(tmp_path / source), str(tmp_path / name), "--half"]) == 0
    assert run(["convert", str(tmp_path / source), str(tmp_path / f"full_{name}")]) == 0
    assert (tmp_path / name).read_bytes() != (tmp_path / f"full_{name}").read_bytes()


@pytest.mark.parametrize(
    ("target", "advice"),
    [
        ("a.usda", "(`nerfbake splats` makes Gaussian splats of it, `nerfbake vdb` makes a volume of it); allowed:"),
        ("a.spz", "(`nerfbake splats` makes Gaussian splats of it); allowed: Gaussian splats"),
        ("a.vdb", "(`nerfbake vdb` makes a volume of it); allowed: a volume"),
    ],
)
def test_a_field_that_becomes_no_such_file_is_told_the_command_that_makes_it(
    target: str, advice: str, tree_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["convert", str(tree_file), str(tree_file.with_name(target))]) == 1
    assert advice in capsys.readouterr().err


def test_a_batch_cannot_know_the_files_of_all_grids() -> None:
    with pytest.raises(click.UsageError, match="--grid all writes files whose names depend on the contents of IN"):
        declared(convert, ["smoke.vdb", "smoke.nvdb", "--grid", "all"])


def test_splats_are_converted_and_the_loss_is_printed(shell: Shell, tmp_path: Path) -> None:
    save(tmp_path / "a.ply", splats(9, degree=1))
    done = shell("convert", "a.ply", "b.spz", "--small", "--in-up", "-z", "--axes", "luf")
    assert (done.returncode, done.stdout) == (0, b"")
    lines = done.stderr.decode().splitlines()
    assert lines[0].startswith("b.spz: 9 splats of SH degree 1, ")
    assert lines[1].startswith("b.spz: largest (median) loss: centres ")
    assert lines[2].endswith(" read only up to 3, which --spz-version 3 writes")
    assert len(lines) == 3
    expected = load(tmp_path / "a.ply", Splats).with_up("-z")
    np.testing.assert_allclose(load(tmp_path / "b.spz", Splats).means, expected.means, atol=1e-5)
    stream = shell("convert", "b.spz", "-", "--to", "glb", "-q", "--in-axes", "RUB").stdout
    assert json.loads(shell("info", "-", "--json", stdin=stream).stdout)["splats"] == 9
    wrong = shell("convert", "a.ply", "c.spz", "--axes", "UPS")
    assert (wrong.returncode, b"'UPS' are no axes of splats; allowed: LDB, RDB, " in wrong.stderr) == (2, True)


def test_cameras_become_those_of_other_programs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    write_metashape(tmp_path, rig(odd=True), calibration="<k1>0.01</k1>")
    assert run(["convert", "cameras.xml", "transforms.json"]) == 0
    assert run(["convert", "cameras.xml", "model/sparse/0", "--to", "colmap"]) == 0
    assert run(["convert", "cameras.xml", "cameras.json", "--to", "3dgs"]) == 0
    assert "the lenses of 3 cameras are left out" in capsys.readouterr().err
    for name in ("transforms.json", "model", "cameras.json"):
        assert len(load(name, Cameras).cameras) == 3
    assert run(["convert", "cameras.xml", "-", "--to", "json"]) == 0
    assert capsys.readouterr().out == (tmp_path / "transforms.json").read_text()
    for options, code, said in (
        (["transforms.json"], 4, "transforms.json exists already"),
        (["a.json", "--half"], 2, "--half has no effect on cameras; allowed: --to and --force"),
        (["a.json", "--min-psnr", "30"], 2, "--min-psnr has no effect on cameras; allowed: --to and --force"),
        (["a.ply", "--resolution", "16"], 2, "--resolution has no effect on splats; allowed: with an octree or a "),
        (["a.vdb", "--min-psnr", "30"], 2, "--min-psnr has no effect on a volume; allowed: with an octree or a "),
        (["a.svo.npz"], 1, "holds cameras"),
        (["-", "--to", "colmap"], 2, "stdout cannot be written as colmap"),
    ):
        assert run(["convert", "cameras.xml", *options]) == code
        assert said in capsys.readouterr().err.replace("transforms.json: exists", "transforms.json exists")
