"""NanoVDB's own tools and library read what we write, and we read what they write."""

from __future__ import annotations

import subprocess
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from nerfbake import load, save
from nerfbake.scene.volume import Volume
from tests.support.nanovdb import GRIDS, Codec, encoded
from tests.support.vdb_readers import SCENES, by_coords, pyopenvdb, tool, transform, tree, volume


@pytest.mark.tools
@pytest.mark.parametrize("codec", ["none", "zip"])
@pytest.mark.parametrize("kind", ["Float", "Vec3f", "Fp16"])
@pytest.mark.parametrize("scene", SCENES)
def test_nanovdbs_tools_take_it(scene: str, kind: str, codec: Codec, tmp_path: Path) -> None:
    grid = GRIDS[kind](SCENES[scene])
    file = tmp_path / "a.nvdb"
    save(file, volume(grid), codec=codec)
    # It exits with 0 whatever it finds: what it says is what counts, and it says nothing of what is right.
    assert tool("nanovdb_validate", file) == ""
    row = next(line.split() for line in tool("nanovdb_print", file).splitlines() if line.startswith("1 "))
    assert row[1:3] == [grid.name, {"Float": "float", "Vec3f": "Vec3f", "Fp16": "Float16"}[kind]]
    assert str(grid.topology.m) in row


# Its own tools print no values of Fp16, and Warp reads zeros: the library itself, every leaf's 512 voxels.
_FP16 = """
#include <nanovdb/util/IO.h>
int main(int, char** files) {
    auto handle = nanovdb::io::readGrid(files[1]);
    auto* grid = handle.grid<nanovdb::Fp16>();
    auto read = grid->getAccessor();
    for (uint32_t i = 0; i < grid->tree().nodeCount(0); ++i) {
        auto& leaf = grid->tree().getFirstLeaf()[i];
        for (uint32_t n = 0; n < 512; ++n) {
            auto at = leaf.offsetToGlobalCoord(n);
            printf("%d %d %d %d %.9g\\n", at[0], at[1], at[2], leaf.isActive(n), read.getValue(at));
        }
    }
}
"""


@pytest.fixture(scope="module")
def fp16_reader(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("fp16")
    (folder / "dump.cpp").write_text(_FP16)
    command = ["g++", "-std=c++17", "-DNANOVDB_USE_ZIP", "dump.cpp", "-o", "dump", "-lz"]
    if subprocess.run(command, cwd=folder, capture_output=True, check=False).returncode:
        pytest.skip("no g++, NanoVDB or zlib headers: `make tools` installs them")
    return folder / "dump"


@pytest.mark.parametrize("codec", ["none", "zip"])
@pytest.mark.parametrize("scene", SCENES)
def test_nanovdb_reads_every_half_voxel(scene: str, codec: Codec, fp16_reader: Path, tmp_path: Path) -> None:
    grid = tree(SCENES[scene], dtype=np.float16)
    save(tmp_path / "a.nvdb", volume(grid), codec=codec)
    lines = np.array([line.split() for line in tool(fp16_reader, tmp_path / "a.nvdb").splitlines()], np.float64)
    lines = lines.reshape(-1, 5)
    assert len(lines) == 512 * len(grid.topology.leaf_mask)
    active = lines[lines[:, 3] == 1]
    seen = by_coords(active[:, :3].astype(int), active[:, 4:].astype(np.float32))
    known = by_coords(grid.topology.coords, grid.values)
    assert seen.keys() == known.keys()
    step = float(grid.values.max(initial=0)) / 65535  # of 16 bits between a leaf's least and greatest
    assert_allclose([seen[place] for place in known], list(known.values()), atol=step)
    assert_allclose(lines[lines[:, 3] == 0, 4], 0, atol=step)
    ours = load(tmp_path / "a.nvdb", Volume).grids[0]
    assert seen == by_coords(ours.topology.coords, ours.values)


@pytest.mark.tools
def test_validation_finds_what_is_broken(tmp_path: Path) -> None:
    data = bytearray(encoded(volume(tree(SCENES["a cloud"]))))
    data[16 + 176 + len("density") + 1 + 620] ^= 1
    (tmp_path / "a.nvdb").write_bytes(data)
    assert "failed" in tool("nanovdb_validate", tmp_path / "a.nvdb")


# Where tiles lie below 0, nanovdb_convert leaves them in OpenVDB's order; ours are sorted by key (nanovdb_reader).
@pytest.mark.tools
@pytest.mark.parametrize("shift", [0, 70, 4000])
@pytest.mark.parametrize("scene", ["one voxel", "a full leaf", "a cloud"])
def test_the_same_bytes_as_nanovdb_convert(scene: str, shift: int, tmp_path: Path) -> None:
    """From our .vdb of the same grid, with all statistics and a partial checksum."""
    made = volume(tree(np.abs(np.unique(np.maximum(SCENES[scene], -70) + shift, axis=0))))
    save(tmp_path / "a.vdb", made)
    save(tmp_path / "a.nvdb", made)
    tool("nanovdb_convert", "-c", "partial", "-s", "all", tmp_path / "a.vdb", tmp_path / "theirs.nvdb")
    assert (tmp_path / "a.nvdb").read_bytes() == (tmp_path / "theirs.nvdb").read_bytes()


@pytest.mark.tools
@pytest.mark.parametrize("codec", ["", "-z", "-b"])
@pytest.mark.parametrize("kind", ["Float", "Vec3f"])
@pytest.mark.parametrize("scene", SCENES)
def test_what_nanovdb_convert_writes_is_read(scene: str, kind: str, codec: str, tmp_path: Path) -> None:
    """Whatever the codec, and whatever the order of the root's tiles."""
    grid = GRIDS[kind](SCENES[scene])
    save(tmp_path / "a.vdb", volume(grid))
    tool("nanovdb_convert", *([codec] if codec else []), tmp_path / "a.vdb", tmp_path / "a.nvdb")
    back = load(tmp_path / "a.nvdb", Volume)
    assert back.problems() == []
    assert_array_equal(back.grids[0].topology.coords, grid.topology.coords)
    assert_array_equal(back.grids[0].values, grid.values)


@pytest.mark.tools
@pytest.mark.parametrize("kind", ["Float", "Vec3f"])
@pytest.mark.parametrize("scene", SCENES)
def test_openvdb_reads_what_nanovdb_convert_makes_of_it(scene: str, kind: str, tmp_path: Path) -> None:
    grid = GRIDS[kind](SCENES[scene])
    save(tmp_path / "a.nvdb", volume(grid))
    tool("nanovdb_convert", tmp_path / "a.nvdb", tmp_path / "a.vdb")
    seen = pyopenvdb(tmp_path / "a.vdb")[grid.name]
    assert by_coords(seen.coords, seen.values) == by_coords(grid.topology.coords, grid.values)
    assert_array_equal(seen.background, grid.background)
    assert_array_equal(seen.transform, transform())
