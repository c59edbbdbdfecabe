"""Volumes of other programs: tiles, level sets, several grids, doubles, quantised values; OpenVDB is the oracle."""

from __future__ import annotations

import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from nerfbake import load, save
from nerfbake.errors import InvalidFile, InvalidScene
from nerfbake.io import check
from nerfbake.scene.vdb import VdbTree
from nerfbake.scene.volume import Volume
from tests.support.foreign_volumes import assert_same, places, seen, write_all, write_types
from tests.support.vdb_readers import tool

pytestmark = pytest.mark.tools
ONE_GRID = ["fog", "fog_half", "colour", "sphere", "sphere_half"]


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("foreign")
    write_all(folder)
    return folder


@pytest.fixture(scope="module")
def types(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("types")
    write_types(folder)
    return folder


def grid_of(path: Path) -> VdbTree:
    made = load(path, Volume)
    assert made.problems() == []
    (grid,) = made.grids
    assert isinstance(grid, VdbTree)
    return grid


@pytest.mark.parametrize("name", ONE_GRID)
def test_every_voxel_and_tile_is_read(name: str, files: Path) -> None:
    grid, (theirs,) = grid_of(files / f"{name}.vdb"), seen(files / f"{name}.vdb")
    assert_same(grid, theirs)
    assert grid.values.dtype == (np.float16 if "half" in name else np.float32)
    assert_array_equal(load(files / f"{name}.vdb", Volume).transform, theirs.transform)


@pytest.mark.parametrize("codec", ["none", "zip"])
@pytest.mark.parametrize("name", ONE_GRID)
def test_openvdb_reads_what_we_write_of_it(name: str, codec: str, files: Path, tmp_path: Path) -> None:
    made = load(files / f"{name}.vdb", Volume)
    save(tmp_path / "a.vdb", made, codec=codec)
    (theirs,) = seen(tmp_path / "a.vdb")
    assert_same(grid_of(files / f"{name}.vdb"), theirs)
    assert theirs.name == made.grids[0].name
    assert_same(grid_of(tmp_path / "a.vdb"), theirs)


@pytest.mark.parametrize("codec", ["none", "zip"])
@pytest.mark.parametrize("name", ["fog", "colour", "sphere"])
def test_nanovdb_reads_what_we_write_of_it(name: str, codec: str, files: Path, tmp_path: Path) -> None:
    save(tmp_path / "a.nvdb", load(files / f"{name}.vdb", Volume), codec=codec)
    assert tool("nanovdb_validate", tmp_path / "a.nvdb") == ""
    tool("nanovdb_convert", tmp_path / "a.nvdb", tmp_path / "back.vdb")
    (theirs,) = seen(tmp_path / "back.vdb")
    assert_same(grid_of(files / f"{name}.vdb"), theirs)
    assert_same(grid_of(tmp_path / "a.nvdb"), theirs)


@pytest.mark.parametrize("name", ["fog", "colour", "sphere"])
def test_the_same_nodes_as_nanovdb_convert(name: str, files: Path, tmp_path: Path) -> None:
    """Statistics and boxes too: as many bytes of each value in both files, whatever the order of the root's tiles."""
    save(tmp_path / "a.nvdb", load(files / f"{name}.vdb", Volume))
    tool("nanovdb_convert", "-c", "partial", "-s", "all", files / f"{name}.vdb", tmp_path / "theirs.nvdb")
    ours, theirs = ((tmp_path / file).read_bytes() for file in ("a.nvdb", "theirs.nvdb"))
    assert len(ours) == len(theirs)
    assert_same(grid_of(tmp_path / "theirs.nvdb"), seen(files / f"{name}.vdb")[0])


@pytest.mark.parametrize("kind", ["fp4", "fp8", "fp16", "fpN"])
@pytest.mark.parametrize("name", ["fog", "sphere"])
def test_quantised_values_are_what_nanovdb_decodes(name: str, kind: str, files: Path, tmp_path: Path) -> None:
    tool("nanovdb_convert", f"--{kind}", files / f"{name}.vdb", tmp_path / "a.nvdb")
    tool("nanovdb_convert", tmp_path / "a.nvdb", tmp_path / "back.vdb")
    grid, (theirs,) = grid_of(tmp_path / "a.nvdb"), seen(tmp_path / "back.vdb")
    assert grid.stored == ("" if kind == "fp16" else kind.replace("fp", "Fp"))
    # Inactive voxels a code beside the background are the background: at most a step of four bits.
    range_of_values = float(grid.values.max() - grid.values.min())
    inactive = ~theirs.on
    rows = grid.topology.rows_at(places())
    table = np.concatenate([grid.values, grid.background[None]])
    assert_allclose(table[rows][inactive], theirs.at[inactive], atol=range_of_values / 15)
    theirs.at[inactive] = table[rows][inactive]
    assert_same(grid, theirs, atol=1e-6)


@pytest.mark.parametrize("name", [*ONE_GRID, "unnamed", "same", "places", "several"])
def test_arrays_hold_all_of_it(name: str, files: Path, tmp_path: Path) -> None:
    made = load(files / f"{name}.vdb", Volume)
    save(tmp_path / "a.vdb.npz", made)
    back = load(tmp_path / "a.vdb.npz", Volume)
    assert back.problems() == []
    assert back.labels == made.labels
    for one, other in zip(made.grids, back.grids, strict=True):
        assert isinstance(one, VdbTree)
        assert isinstance(other, VdbTree)
        assert one.topology.same_as(other.topology)
        assert_array_equal(one.values, other.values)
        assert_array_equal(one.active_topology.coords, other.active_topology.coords)
        assert (one.grid_class, one.background.tolist()) == (other.grid_class, other.background.tolist())
        assert_array_equal(made.transform_of(one), back.transform_of(other))


@pytest.mark.parametrize("name", ["fog", "sphere"])
def test_inside_and_outside_read_as_they_are(name: str, files: Path) -> None:
    """sample() at whole and at half voxels, tiles and inactive values among them."""
    grid, (theirs,) = grid_of(files / f"{name}.vdb"), seen(files / f"{name}.vdb")
    assert_array_equal(grid.sample(places()), theirs.at)
    assert_allclose(grid.sample(places(), lookup="trilinear"), theirs.at)
    between = grid.sample(places()[:, None] + np.array([[0, 0, 0], [0.5, 0, 0], [1, 0, 0]]), lookup="trilinear")
    assert_allclose(between[:, 1], (between[:, 0] + between[:, 2]) / 2, atol=1e-6)


def test_a_level_set_is_negative_inside(files: Path, tmp_path: Path) -> None:
    """The centre of the sphere, and far away, in all three formats and back."""
    made = load(files / "sphere.vdb", Volume)
    for name in ("a.vdb", "a.nvdb", "a.vdb.npz"):
        save(tmp_path / name, made)
        made = load(tmp_path / name, Volume)
        grid = made.grids[0]
        inside, outside = made.index_of([[0.5, 0, -1], [0.5, 0, 5]])
        assert_allclose(grid.sample([inside, outside])[:, 0], [-0.3, 0.3])
        assert check(tmp_path / name) == []


# -- several grids ---------------------------------------------------------------------------------------------
def test_grids_without_names_are_in_the_order_of_their_numbers(files: Path, tmp_path: Path) -> None:
    tool("nanovdb_convert", files / "unnamed.vdb", tmp_path / "a.nvdb")
    for path in (files / "unnamed.vdb", tmp_path / "a.nvdb"):
        made = load(path, Volume)
        assert made.labels == [f"[{i}]" for i in range(12)]
        assert [grid.topology.m for grid in made.grids] == list(range(1, 13))
        assert made.only(["[11]", "3"]).grids == (made.grids[11], made.grids[3])
        for name in ("12", "0000000003", "1000000000"):
            with pytest.raises(InvalidScene, match=f"has no grid '{name}'"):
                made.only([name])


def test_grids_of_one_name_are_told_apart(files: Path) -> None:
    made = load(files / "same.vdb", Volume)
    assert dict(zip(made.labels, (grid.topology.m for grid in made.grids), strict=True)) == {
        "a[0]": 2,
        "a[1]": 4,
        "b": 3,
    }


def test_each_grid_has_its_place(files: Path, tmp_path: Path) -> None:
    made = load(files / "places.vdb", Volume)
    save(tmp_path / "a.vdb", made)
    for path in (files / "places.vdb", tmp_path / "a.vdb"):
        for grid in load(path, Volume).grids:
            theirs = next(each for each in seen(path) if each.name == grid.name)
            assert isinstance(grid, VdbTree)
            assert_same(grid, theirs)
            assert_array_equal(load(path, Volume).transform_of(grid), theirs.transform)


@pytest.mark.parametrize("codec", ["", "-z", "-b"])
def test_several_grids_of_a_nanovdb_are_read(codec: str, files: Path, tmp_path: Path) -> None:
    tool("nanovdb_convert", *([codec] if codec else []), files / "several.vdb", tmp_path / "a.nvdb")
    made, theirs = load(tmp_path / "a.nvdb", Volume), {each.name: each for each in seen(files / "several.vdb")}
    assert made.problems() == []
    assert sorted(made.labels) == ["Cd", "density", "ls"]
    for grid in made.grids:
        assert isinstance(grid, VdbTree)
        assert_same(grid, theirs[grid.name])
        assert_array_equal(made.transform_of(grid), theirs[grid.name].transform)


def test_what_stands_behind_the_grids_is_not_passed_over(files: Path, tmp_path: Path) -> None:
    tool("nanovdb_convert", files / "sphere.vdb", tmp_path / "a.nvdb")
    for path in (files / "sphere.vdb", tmp_path / "a.nvdb"):
        for more in (b"\0" * 9, b"\0" * 99):
            (tmp_path / f"b{path.suffix}").write_bytes(path.read_bytes() + more)
            (problem,) = check(tmp_path / f"b{path.suffix}")
            assert "after the grids" in str(problem) or "after the last grid" in str(problem)


def test_a_grid_that_cannot_be_read_is_named(files: Path, types: Path, tmp_path: Path) -> None:
    made = load(files / "mixed.vdb", Volume)
    assert made.labels == ["density", "heat"]
    (problem,) = check(files / "mixed.vdb")
    assert str(problem).startswith("grid 'mask' is a Tree_bool_5_4_3; allowed: trees 5_4_3 of float, double")
    with pytest.raises(InvalidFile, match="grid 'mask' is a Tree_bool_5_4_3"):
        load(files / "mask.vdb", Volume)
    with pytest.raises(InvalidFile, match="grid 'density' is a Tree_int32_5_4_3"):
        load(types / "int.vdb", Volume)
    with pytest.raises(InvalidFile, match=r"grid 'density' has values of type Int32; allowed: Float, Double"):
        load(types / "int.nvdb", Volume)
    tool("nanovdb_convert", files / "sphere.vdb", tmp_path / "a.nvdb")
    (tmp_path / "b.nvdb").write_bytes((tmp_path / "a.nvdb").read_bytes() + (types / "int.nvdb").read_bytes())
    assert [str(problem).partition(";")[0] for problem in check(tmp_path / "b.nvdb")] == [
        "grid 'density' has values of type Int32"
    ]


# -- other values ----------------------------------------------------------------------------------------------
def test_doubles_are_read_as_floats(types: Path) -> None:
    coords = np.array([[3 * i - 50, i, -i] for i in range(100)])
    for name in ("double.vdb", "double.nvdb"):
        grid = grid_of(types / name)
        assert (grid.stored, grid.topology.m) == ("double", 100)
        assert_array_equal(grid.sample(coords)[:, 0], (0.1 + np.arange(100)).astype(np.float32))


def test_a_stream_is_read_where_offsets_mean_nothing(files: Path, tmp_path: Path) -> None:
    """io::Stream writes 0 for 'has offsets' and zeros for them, and is the same else."""
    data = bytearray((files / "sphere.vdb").read_bytes())
    data[20] = 0
    end = bytes(data).index(len(data).to_bytes(8, "little"))
    data[end - 16 : end + 8] = bytes(24)
    (tmp_path / "a.vdb").write_bytes(data)
    assert_same(grid_of(tmp_path / "a.vdb"), seen(files / "sphere.vdb")[0])


def test_a_version_that_is_none_is_said(files: Path, tmp_path: Path) -> None:
    data = bytearray((files / "sphere.vdb").read_bytes())
    data[8] = 221
    (tmp_path / "a.vdb").write_bytes(data)
    with pytest.raises(InvalidFile, match="the file has version 221; allowed: 222 to 225"):
        load(tmp_path / "a.vdb", Volume)


def test_values_that_differ_in_many_ways_are_written_whole(files: Path, tmp_path: Path) -> None:
    """Inactive values beyond the background and its negative: every slot of such a node is stored."""
    made = load(files / "sphere.vdb", Volume)
    (grid,) = made.grids
    assert isinstance(grid, VdbTree)
    assert grid.active is not None
    values = grid.values.copy()
    values[~grid.active] = np.linspace(1, 2, int(np.count_nonzero(~grid.active)))[:, None]
    other = replace(grid, values=values)
    save(tmp_path / "a.vdb", replace(made, grids=(other,)))
    assert_same(other, seen(tmp_path / "a.vdb")[0])
    assert_array_equal(grid_of(tmp_path / "a.vdb").values, values)


def test_sizes_are_those_of_the_tools(files: Path, tmp_path: Path) -> None:
    save(tmp_path / "a.nvdb", load(files / "fog.vdb", Volume))
    said = subprocess.run(["vdb_print", "-l", files / "fog.vdb"], capture_output=True, text=True, check=True).stdout
    voxels, tiles = (
        int(said.partition(f"Number of active {what}:")[2].split()[0].replace(",", "")) for what in ("voxels", "tiles")
    )
    active = grid_of(files / "fog.vdb").active_topology
    assert (active.voxel_count, sum(active.tile_counts)) == (voxels, tiles)
    row = next(
        line.split() for line in tool("nanovdb_print", tmp_path / "a.nvdb").splitlines() if line.startswith("1 ")
    )
    assert "FOG" in row
