"""An octree that does not fit into --max-memory is written part by part from the tree that does."""

from __future__ import annotations

import os
import struct
import subprocess
import sys
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from numpy.testing import assert_array_equal

from nerfbake import IndexGrid, Volume, load, save
from nerfbake.errors import MemoryLimit
from nerfbake.jobs.octrees import bake_octree, bake_volume
from nerfbake.memory import memory_limit
from nerfbake.scene.n3tree import N3Tree
from tests.conftest import REPOSITORY

MEMORY = 256 << 20
SLACK = 16 << 20  # as of test_memory_peaks: what the interpreter itself may take meanwhile

PEAK = """
import sys
from nerfbake.cli.main import main
try:
    main()
finally:
    with open("/proc/self/status") as file:
        print(next(line.split()[1] for line in file if line.startswith("VmHWM")))
"""


def surface(splits: list[int], *, hollow: bool = False) -> N3Tree:
    """A tree of SH9 without two equal leaves: every node of depth d splits splits[d] of its cells, as surfaces do.

    hollow: only the finest leaves hold anything.
    """
    rng = np.random.default_rng(0)
    counts = np.cumprod([1, *splits])
    n = int(counts.sum())
    child, first = np.zeros((n, 8), np.int32), 0
    for split, count in zip(splits, counts, strict=False):
        rows = np.arange(first, first + count)
        for k in range(split):
            child[rows, (rows + (k if split > 4 else 2 * k)) % 8] = first + count + np.arange(count) * split + k - rows
        first += count
    bits = rng.integers(0x2C00, 0x3C00, (8 * n, 28), np.uint16)  # of float16 from 1/16 to 1
    bits[:, -1] += 0x1800  # densities from 4 to 64
    if hollow:
        bits[: -8 * int(counts[-1]), -1] = 0
    cells = bits.view(np.float16).reshape(n, 2, 2, 2, 28)
    return N3Tree(child.reshape(n, 2, 2, 2), cells, np.full(3, 0.5), np.full(3, 0.5), "SH9")


def members(path: Path) -> dict[str, npt.NDArray[Any]]:
    """The two large arrays of a written file, mapped: only the rows that are looked at are read."""
    found: dict[str, npt.NDArray[Any]] = {}
    with zipfile.ZipFile(path) as archive, open(path, "rb") as file:
        for name in ("node_children", "node_data"):
            file.seek(archive.getinfo(f"{name}.npy").header_offset + 26)
            file.seek(sum(struct.unpack("<HH", file.read(4))), os.SEEK_CUR)
            np.lib.format.read_magic(file)
            shape, _, dtype = np.lib.format.read_array_header_1_0(file)
            found[name] = np.memmap(path, dtype, "r", file.tell(), shape)
    return found


def assert_leaves_are_those_of(tree: N3Tree, path: Path, *, tries: int) -> None:
    """Random ways down the tree and the written octree end at the same values; most go as deep as they can."""
    arrays, rng = members(path), np.random.default_rng(1)
    for _ in range(tries):
        row = node = 0
        while True:
            split = np.argwhere(tree.child[row])
            x, y, z = rng.choice(split) if len(split) and rng.random() < 0.9 else rng.integers(0, 2, 3)
            node = int(arrays["node_children"][node, x + 2 * y + 4 * z])
            assert node > 0
            if not tree.child[row, x, y, z]:
                break
            row += int(tree.child[row, x, y, z])
        assert arrays["node_data"][node].tolist() == tree.data[row, x, y, z].tolist()


def assert_voxels_are_those_of(tree: N3Tree, grid: IndexGrid, *, tries: int) -> None:
    """Random ways down a hollow tree to its finest leaves: the grid reads the same there."""
    rng, points, rows = np.random.default_rng(1), [], []
    for _ in range(tries):
        row, place = 0, np.zeros(3, np.int64)
        while len(split := np.argwhere(tree.child[row])):
            cell = rng.choice(split)
            row, place = row + int(tree.child[row, *cell]), 2 * place + cell
        cell = rng.integers(0, 2, 3)
        points.append(2 * place + cell)
        rows.append(tree.data[row, *cell])
    assert_array_equal(grid.sample(np.array(points)), np.array(rows, np.float32))


@pytest.mark.parametrize("suffix", [".nvdb", ".vdb.npz"])
def test_an_index_larger_than_the_memory_is_written_and_the_same_to_the_byte(suffix: str, tmp_path: Path) -> None:
    tree = surface([4] * 5, hollow=True)  # 64^3
    save(tmp_path / "tree.npz", tree)
    whole, part = tmp_path / f"whole{suffix}", tmp_path / f"part{suffix}"
    # An octree of a file has its rows as an array, and so has the table that is made of them.
    octree = bake_octree(tmp_path / "tree.npz", tmp_path / "tree.svo.npz", layout="full")
    (grid,) = bake_volume(tmp_path / "tree.svo.npz", whole, grids="index").grids
    assert isinstance(grid, IndexGrid)
    with memory_limit(octree.node_rows.nbytes * 5 // 4):
        bake_volume(tmp_path / "tree.npz", part, grids="index")
        with pytest.raises(MemoryLimit, match=r"node_data, made at once, needs"):
            bake_volume(tmp_path / "tree.npz", tmp_path / "part.vdb", grids="density,sh")
    assert part.read_bytes() == whole.read_bytes()
    assert_voxels_are_those_of(tree, grid, tries=100)


def test_an_octree_larger_than_the_memory_is_written_and_the_same_to_the_byte(tmp_path: Path) -> None:
    tree = surface([4] * 5)  # 64^3
    save(tmp_path / "tree.npz", tree)
    whole = bake_octree(tmp_path / "tree.npz", tmp_path / "whole.svo.npz", layout="compact")
    assert (whole.size, whole.n) == ((64, 64, 64), 8 * tree.n + 1)
    limit = whole.node_rows.nbytes
    with memory_limit(limit):
        bake_octree(tmp_path / "tree.npz", tmp_path / "part.svo.npz", layout="compact")
        with pytest.raises(MemoryLimit, match=r"node_data, made at once, needs 1\.2 MiB in .*; allowed: 1\.2 MiB"):
            bake_octree(tmp_path / "tree.npz", tmp_path / "part.svo.capnp", layout="compact")
    assert (tmp_path / "part.svo.npz").read_bytes() == (tmp_path / "whole.svo.npz").read_bytes()
    assert not (tmp_path / "part.svo.capnp").exists()
    assert_leaves_are_those_of(tree, tmp_path / "part.svo.npz", tries=100)


@pytest.mark.long
def test_an_octree_of_1024_beyond_the_memory_is_written_within_it(tmp_path: Path) -> None:
    tree = surface([4] * 8 + [3])
    save(tmp_path / "tree.npz", tree)
    save(tmp_path / "small.npz", surface([4]))
    options = ["--layout", "compact"]
    interpreter = peak_of("svo", tmp_path / "small.npz", tmp_path / "small.svo.npz", *options)
    peak = peak_of("svo", tmp_path / "tree.npz", tmp_path / "tree.svo.npz", *options)
    arrays = members(tmp_path / "tree.svo.npz")
    assert sum(array.nbytes for array in arrays.values()) > MEMORY
    assert peak - interpreter < MEMORY + SLACK
    with zipfile.ZipFile(tmp_path / "tree.svo.npz") as archive:
        assert archive.testzip() is None
    assert_leaves_are_those_of(tree, tmp_path / "tree.svo.npz", tries=1000)


@pytest.mark.long
def test_an_index_of_1024_whose_octree_is_beyond_the_memory_is_written_within_it(tmp_path: Path) -> None:
    tree = surface([2, 2, *[4] * 5, 8, 8], hollow=True)
    save(tmp_path / "tree.npz", tree)
    save(tmp_path / "small.npz", surface([4], hollow=True))
    interpreter = peak_of("vdb", tmp_path / "small.npz", tmp_path / "small.nvdb", "--grids", "index")
    peak = peak_of("vdb", tmp_path / "tree.npz", tmp_path / "tree.nvdb", "--grids", "index")
    assert peak - interpreter < MEMORY + SLACK
    (grid,) = load(tmp_path / "tree.nvdb", Volume).grids
    assert isinstance(grid, IndexGrid)
    inner = tree.n  # nodes of the octree above its leaves, and child slots for all of those
    assert (grid.topology.m + inner) * grid.table.itemsize * 28 + inner * 8 * 4 > MEMORY
    assert_voxels_are_those_of(tree, grid, tries=1000)


def peak_of(command: str, source: Path, target: Path, *options: str) -> int:
    """Bytes that the command's process held at most, its interpreter and all libraries included."""
    line = [
        sys.executable,
        "-c",
        PEAK,
        command,
        str(source),
        str(target),
        *options,
        "--max-memory",
        "256MiB",
        "--quiet",
    ]
    environment = os.environ | {"PYTHONPATH": str(REPOSITORY)}
    done = subprocess.run(line, env=environment, capture_output=True, text=True, check=True)
    return int(done.stdout) << 10
