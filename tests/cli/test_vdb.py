"""`nerfbake vdb` and back, as a shell sees it; what info and check say."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from nerfbake import N3Tree, SparseVoxelOctree, build_field, build_octree, load, orbit_cameras, save
from nerfbake.scene.volume import Volume
from tests.conftest import Shell
from tests.support.scenes import assert_same_octree, n3tree
from tests.support.splats import ball_of_splats


@pytest.fixture
def tree_file(tmp_path: Path) -> Path:
    save(tmp_path / "a.npz", n3tree(splits=[(0, (1, 0, 1))], data_format="SH4"))
    return tmp_path / "a.npz"


@pytest.mark.usefixtures("tree_file")
@pytest.mark.parametrize(
    ("out", "options", "names"),
    [
        ("b.vdb", [], ["density", "Cd"]),
        ("b.nvdb", [], ["density"]),
        ("b.nvdb", ["--grids", "index", "--codec", "zip"], ["index"]),
        ("b.vdb", ["--grids", "density,sh"], ["density", "sh_0", "sh_1", "sh_2", "sh_3"]),
        ("b.vdb.npz", [], ["density", "Cd"]),
        ("b.vdb.npz", ["--grids", "index", "--half"], ["index"]),
        ("b.nvdb.zst", ["--codec", "zip"], ["density"]),
        ("b.vdb", ["--half", "--codec", "none", "--up", "y", "--resolution", "8", "--sigma-min", "1.5"], None),
    ],
)
def test_options_of_vdb(shell: Shell, tmp_path: Path, out: str, options: list[str], names: list[str] | None) -> None:
    done = shell("vdb", "a.npz", out, *options)
    assert (done.returncode, done.stdout, done.stderr.count(b"\n")) == (0, b"", 1)
    made = load(tmp_path / out, Volume)
    assert [grid.name for grid in made.grids] == (names or ["density", "Cd"])
    assert made.grids[0].values.dtype == (np.float16 if "--half" in options else np.float32)
    assert made.transform[1, 2] == (0.125 if "--up" in options else 0)
    assert shell("check", out).returncode == 0
    told = json.loads(shell("info", out, "--json").stdout)
    assert told["grid_names"] == [grid.name for grid in made.grids]
    first = told["grids"][told["grid_names"][0]]
    assert (first["active_voxels"], first["nodes_per_level"]) == (made.grids[0].topology.m, [1, 1, 1, 1])
    assert first["class"] == ("index" if told["grid_names"] == ["index"] else "fog volume")
    assert told["checksum"] == ("half" if "nvdb" in out else "none")
    assert f"grid {made.grids[0].name}" in shell("info", out).stdout.decode()


@pytest.mark.usefixtures("tree_file")
def test_there_and_back_through_pipes(shell: Shell, tmp_path: Path) -> None:
    octree = build_octree(load(tmp_path / "a.npz"))
    for options in (
        ["--to", "nvdb", "--grids", "index"],
        ["--to", "vdb", "--grids", "density,sh"],
        ["--to", "vdb.npz", "--grids", "density,sh"],
    ):
        first = shell("vdb", "a.npz", "-", *options)
        assert first.returncode == 0
        second = shell("convert", "-", "b.svo.npz", "--force", stdin=first.stdout)
        assert second.returncode == 0
        assert_same_octree(load(tmp_path / "b.svo.npz", SparseVoxelOctree), octree)


@pytest.mark.usefixtures("tree_file")
@pytest.mark.parametrize(
    ("arguments", "code", "said"),
    [
        (["vdb", "a.npz", "b.obj"], 2, "for a volume (`nerfbake mesh` makes a mesh); allowed: .vdb.npz, .vdb"),
        (["vdb", "a.npz", "-"], 2, "stdout has no file extension; allowed: --to FORMAT"),
        (["vdb", "a.npz", "b.vdb", "--grids", "colour"], 2, "--grids are 'colour'; allowed: some of density"),
        (["vdb", "a.npz", "b.vdb", "--grids", "index"], 2, "a .vdb has no index grids; allowed"),
        (
            ["vdb", "a.npz", "b.nvdb", "--grids", "density,Cd"],
            2,
            "a .nvdb would contain the grids density,Cd; allowed: one",
        ),
        (["vdb", "a.npz", "b.nvdb", "--grids", "Cd", "--half"], 2, "a .nvdb has no half colours"),
        (["vdb", "a.npz", "b.vdb", "--max-memory", "1000"], 1, "a.npz: "),
        (["vdb", "a.npz", "b.vdb.npz", "--codec", "zip"], 2, "vdb.npz takes no option 'codec'; allowed: none"),
        (["vdb", "a.svo.npz", "b.vdb", "--resolution", "8"], 2, "--resolution has no effect on an octree"),
        (["convert", "a.vdb", "b.svo.npz"], 1, "a.vdb: the volume has the grids density, Cd; allowed: density,sh or"),
        (["convert", "a.vdb", "b.nvdb"], 1, "b.nvdb: a .nvdb would contain 2 grids: density, Cd; allowed: --grid NAME"),
        (["convert", "a.vdb", "b.vdb", "--grid", "2"], 1, "a.vdb: the volume has no grid '2'; allowed: density, Cd"),
        (["convert", "a.vdb", "b.vdb", "--layout", "full"], 2, "a volume has no child slots; allowed: no --layout"),
        (["convert", "a.vdb", "b.vdb", "--no-child=-1"], 2, "a volume has no child slots"),
        (["convert", "a.vdb", "b.vdb.npz", "--codec", "zip"], 2, "vdb.npz takes no option 'codec'"),
        (
            ["convert", "a.vdb", "b.svo.npz", "--codec", "zip"],
            2,
            "svo.npz takes no option 'codec'; allowed: no_child",
        ),
        (["convert", "a.vdb", "b.svo.npz", "--in-up", "y"], 2, "the octree in IN keeps its own axes"),
        (["convert", "a.svo.npz", "b.svo.npz", "--half"], 2, "--half is for volumes"),
        (
            ["convert", "a.svo.npz", "b.svo.npz", "--grid", "density"],
            2,
            "a.svo.npz is not a volume; allowed: no --grid",
        ),
        (["convert", "a.svo.npz", "b.nvdb"], 1, "holds an octree"),
        (
            ["render", "a.npz", "--out", "b.png", "--in-up", "y"],
            2,
            "a.npz is not a volume; allowed: no --grid and no --in-up",
        ),
    ],
)
def test_wrong_usage(shell: Shell, tmp_path: Path, arguments: list[str], code: int, said: str) -> None:
    shell("svo", "a.npz", "a.svo.npz")
    shell("vdb", "a.npz", "a.vdb")
    done = shell(*arguments)
    assert (done.returncode, done.stderr.count(b"\n")) == (code, 1)
    assert said in done.stderr.decode()
    assert not any((tmp_path / name).exists() for name in ("b.vdb", "b.nvdb", "b.obj", "b.svo.npz", "b.png"))


@pytest.mark.usefixtures("tree_file")
def test_a_half_density_says_what_warp_makes_of_it(shell: Shell) -> None:
    done = shell("vdb", "a.npz", "b.nvdb", "--half")
    assert b"note: half densities in a .nvdb are Fp16, which Warp loads and then reads as zeros" in done.stderr


@pytest.mark.usefixtures("tree_file")
def test_what_arguments_cannot_hold_is_said_before_in_is_read(shell: Shell, tmp_path: Path) -> None:
    (tmp_path / "a.npz").write_bytes(b"no tree")
    for wrong in (["b.nvdb", "--grids", "density,Cd"], ["b.vdb", "--grids", "index"], ["b.nvdb", "--grids", "sh"]):
        assert shell("vdb", "a.npz", *wrong).returncode == 2


@pytest.mark.usefixtures("tree_file")
def test_volumes_are_converted_without_loss(shell: Shell, tmp_path: Path) -> None:
    """.vdb -> .nvdb -> .vdb.npz -> .vdb, halves too; --half rounds as `vdb --half` does."""
    shell("vdb", "a.npz", "a.vdb", "--grids", "density")
    shell("vdb", "a.npz", "half.vdb", "--grids", "density", "--half")
    for first in ("a", "half"):
        for one, other in ((f"{first}.vdb", "b.nvdb"), ("b.nvdb", "b.vdb.npz"), ("b.vdb.npz", "b.vdb")):
            done = shell("convert", one, other, "--force")
            assert (done.returncode, done.stderr.count(b"\n")) == (0, 1)
        ours, theirs = (load(tmp_path / name, Volume).grids[0] for name in (f"{first}.vdb", "b.vdb"))
        assert ours.topology.same_as(theirs.topology)
        assert theirs.values.dtype == np.float32
        assert np.array_equal(ours.values.astype(np.float32), theirs.values)
    shell("convert", "a.vdb", "c.vdb", "--half", "--codec", "none")
    shell("vdb", "a.npz", "d.vdb", "--grids", "density", "--half", "--codec", "none")
    values = [load(tmp_path / name, Volume).grids[0].values for name in ("c.vdb", "d.vdb")]
    assert values[0].tobytes() == values[1].tobytes()
    assert shell("convert", "a.vdb", "index.vdb.npz", "--grid", "1").returncode == 1


@pytest.mark.usefixtures("tree_file")
def test_y_up_is_judged_and_turned_back(shell: Shell, tmp_path: Path) -> None:
    done = shell("vdb", "a.npz", "y.vdb", "--grids", "density,sh", "--up", "y", "--min-psnr", "60")
    assert done.returncode == 0, done.stderr
    shell("vdb", "a.npz", "z.vdb", "--grids", "density,sh")
    shell("convert", "y.vdb", "back.vdb", "--in-up", "y")
    assert np.array_equal(load(tmp_path / "back.vdb", Volume).transform, load(tmp_path / "z.vdb", Volume).transform)
    for name, options in (("y", ["--in-up", "y"]), ("z", [])):
        assert shell("render", f"{name}.vdb", "--out", f"{name}.png", "--size", "24x20", *options).returncode == 0
    assert (tmp_path / "y.png").read_bytes() == (tmp_path / "z.png").read_bytes()


@pytest.mark.usefixtures("tree_file")
def test_volumes_have_budgets_too(shell: Shell, tmp_path: Path) -> None:
    field = build_field(load(tmp_path / "a.npz", N3Tree))
    save(tmp_path / "c.json", orbit_cameras(field, frames=2, width=24, height=20))
    budget = ["--cameras", "c.json", "--min-psnr", "50"]
    assert shell("vdb", "a.npz", "good.nvdb", "--grids", "index", *budget).returncode == 0
    assert shell("compare", "a.npz", "good.nvdb", "--cameras", "c.json", "--min-psnr", "60").returncode == 0
    assert shell("vdb", "a.npz", "grey.vdb", "--grids", "density", *budget).returncode == 3
    assert sorted(path.name for path in tmp_path.glob("*vdb*")) == ["good.nvdb", "grey.vdb.rejected"]
    # Judged in the octree's own world, although the file stands in another.
    assert shell("vdb", "a.npz", "turned.nvdb", "--grids", "index", "--up", "y", *budget).returncode == 0


def test_splats_stand_upright(shell: Shell, tmp_path: Path) -> None:
    save(tmp_path / "a.ply", ball_of_splats())
    options = ["--resolution", "16", "--epochs", "0", "--box=-2,-2,0,2,2,2"]
    assert shell("vdb", "a.ply", "b.vdb", *options).returncode == 0
    assert shell("vdb", "a.ply", "c.vdb", *options, "--in-up", "z").returncode == 0
    for name, green in (("b.vdb", 0.25), ("c.vdb", 0.5)):  # y of the splats is green, and points down
        volume = load(tmp_path / name, Volume)
        dense = volume.grid("density").values[:, 0] > 1
        assert abs(volume.grid("Cd").values[dense, 1].mean() - green) < 0.06
