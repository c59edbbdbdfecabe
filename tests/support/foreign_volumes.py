"""Volumes written by OpenVDB and NanoVDB, with their contents as read by pyopenvdb."""

from __future__ import annotations

import io
import subprocess
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from nerfbake.scene.vdb import VdbTree

# Grids of every kind that pyopenvdb can create: tiles on all levels, inactive values, missing and duplicate names,
# a transform, and a tree that two grids share.
_WRITE = """
import sys, pyopenvdb as vdb
def fog(name, kind=vdb.FloatGrid, half=False):
    grid = kind()
    grid.name, grid.saveFloatAsHalf = name, half
    def value(number):
        return number if kind is vdb.FloatGrid else (number, 2 * number, -number)
    grid.fill((0, 0, 0), (4095, 4095, 4095), value(0.5))
    grid.fill((-128, 0, 0), (-1, 127, 127), value(0.25))
    grid.fill((-256, 0, 0), (-249, 7, 7), value(2.0))
    grid.fill((-240, 3, 1), (-237, 12, 2), value(0.75))
    grid.fill((-200, 0, 0), (-193, 7, 7), value(3.0), False)
    grid.fill((-190, 1, 1), (-188, 2, 2), value(-4.0), False)
    grid.fill((4096, -4096, 0), (8191, -1, 4095), value(1.5), False)
    accessor = grid.getAccessor()
    for i in range(90):
        accessor.setValueOn((-300 - 7 * i, i, 5 * i), value(i / 64))
    return grid
def sphere(name, half=False):
    grid = vdb.createLevelSetSphere(radius=2.0, voxelSize=0.1, center=(0.5, 0.0, -1.0))
    grid.name, grid.saveFloatAsHalf = name, half
    return grid
def line(count, name=""):
    grid = vdb.FloatGrid()
    grid.name = name
    grid.fill((0, 0, 0), (count, 0, 0), float(count))
    return grid
moved = line(3, "moved")
moved.transform = vdb.createLinearTransform([[0.5, 0, 0, 0], [0, 0, 2, 0], [0, -1, 0, 0], [1, 2, 3, 1]])
twin = moved.copy()
twin.name = "twin"
smoke = fog("density")
smoke.gridClass = "fog volume"
mask = vdb.BoolGrid()
mask.name = "mask"
mask.fill((0, 0, 0), (3, 3, 3), True)
files = {
    "fog": [smoke], "fog_half": [fog("half", half=True)], "colour": [fog("Cd", vdb.Vec3SGrid)],
    "sphere": [sphere("ls")], "sphere_half": [sphere("ls", True)],
    "unnamed": [line(i) for i in range(12)], "same": [line(1, "a"), line(2, "b"), line(3, "a")],
    "places": [line(2, "plain"), moved, twin], "mixed": [line(2, "density"), mask, line(3, "heat")], "mask": [mask],
    "several": [sphere("ls"), smoke, fog("Cd", vdb.Vec3SGrid)],
}
for name, grids in files.items():
    vdb.write(f"{sys.argv[1]}/{name}.vdb", grids=grids)
"""

# All active items as boxes, and the values at some points, active or not.
_DUMP = """
import sys, numpy, pyopenvdb
grids, _ = pyopenvdb.readAll(sys.argv[1])
places = numpy.load(sys.argv[2])
out = {}
for i, grid in enumerate(grids):
    items = [(item.min, item.max, item.value) for item in grid.citerOnValues()]
    out[f"{i}.low"] = numpy.array([item[0] for item in items], "i8").reshape(-1, 3)
    out[f"{i}.high"] = numpy.array([item[1] for item in items], "i8").reshape(-1, 3)
    out[f"{i}.values"] = numpy.array([item[2] for item in items], "f8")
    reader = grid.getConstAccessor()
    found = [reader.probeValue(tuple(int(x) for x in place)) for place in places]
    out[f"{i}.at"] = numpy.array([value for value, _ in found], "f8")
    out[f"{i}.on"] = numpy.array([on for _, on in found], bool)
    out[f"{i}.class"] = grid.gridClass
    out[f"{i}.name"] = grid.name
    corners = ((0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1))
    out[f"{i}.world"] = numpy.array([grid.transform.indexToWorld(corner) for corner in corners])
numpy.savez(sys.argv[3], count=len(grids), **out)
"""


def write_all(folder: Path) -> None:
    """Write the files of _WRITE to a folder."""
    subprocess.run(["/usr/bin/python3", "-c", _WRITE, str(folder)], check=True, timeout=60)


def places() -> npt.NDArray[np.int64]:
    """Coordinates around all grids of _WRITE, including their corners and the voxels just outside."""
    random = np.random.default_rng(3)
    axes = (-257, -256, -201, -200, -193, -129, -128, -1, 0, 4095, 4096, 8191, 8192), (-4097, -4096, -1, 0, 7, 8, 128)
    corners = np.stack(np.meshgrid(*axes, (-1, 0, 7, 8, 4095, 4096), indexing="ij"), axis=-1).reshape(-1, 3)
    near = random.integers((-270, -3, -3), (-120, 20, 20), (1500, 3))
    return np.concatenate([corners, near, random.integers(-32, 32, (1500, 3)), random.integers(-9000, 9000, (200, 3))])


class Seen:
    """A grid as read by OpenVDB."""

    def __init__(self, dump: Any, i: int) -> None:
        self.low, self.high = dump[f"{i}.low"], dump[f"{i}.high"]
        self.at, self.on = dump[f"{i}.at"].reshape(len(dump[f"{i}.at"]), -1), dump[f"{i}.on"]
        self.values = dump[f"{i}.values"].reshape(len(self.low), -1)
        self.grid_class, self.name = str(dump[f"{i}.class"]), str(dump[f"{i}.name"])
        world = dump[f"{i}.world"]
        self.transform = np.column_stack([(world[1:] - world[0]).T, world[0]])


def seen(path: Path) -> list[Seen]:
    """Read the grids of a file with pyopenvdb, in a separate interpreter: once for the same bytes."""
    with np.load(io.BytesIO(_dumped(path.read_bytes()))) as npz:
        return [Seen(npz, i) for i in range(int(npz["count"]))]


@cache
def _dumped(content: bytes) -> bytes:
    with TemporaryDirectory() as folder:
        path, where, dump = (Path(folder) / name for name in ("a.vdb", "places.npy", "seen.npz"))
        path.write_bytes(content)
        np.save(where, places())
        subprocess.run(["/usr/bin/python3", "-c", _DUMP, str(path), str(where), str(dump)], check=True, timeout=60)
        return dump.read_bytes()


def assert_same(grid: VdbTree, theirs: Seen, *, atol: float = 0) -> None:
    """Assert that both grids have the same active voxels and tiles, and the same values and states at places()."""
    active = grid.active_topology
    cubes = [(active.coords, 1), *active.tile_cubes]
    low = np.concatenate([low for low, _ in cubes]).astype(np.int64)
    high = np.concatenate([low.astype(np.int64) + edge - 1 for low, edge in cubes])
    own = {(*a, *b): v for a, b, v in zip(low.tolist(), high.tolist(), grid.active_values.tolist(), strict=True)}
    other = {
        (*a, *b): v for a, b, v in zip(theirs.low.tolist(), theirs.high.tolist(), theirs.values.tolist(), strict=True)
    }
    assert own.keys() == other.keys()
    np.testing.assert_allclose(list(own.values()), [other[key] for key in own], rtol=0, atol=atol)
    rows = grid.topology.rows_at(places())
    table = np.concatenate([grid.values.astype(np.float32), grid.background[None]])
    np.testing.assert_allclose(table[rows], theirs.at, rtol=0, atol=atol)
    on = np.append(np.ones(len(grid.values), bool) if grid.active is None else grid.active, False)
    np.testing.assert_array_equal(on[rows], theirs.on)
    assert grid.grid_class == theirs.grid_class


_TYPES = """
#include <nanovdb/util/GridBuilder.h>
#include <nanovdb/util/IO.h>
template <typename T> void write(const char* name) {
    nanovdb::GridBuilder<T> builder(T(0));
    auto accessor = builder.getAccessor();
    for (int i = 0; i < 100; ++i) accessor.setValue(nanovdb::Coord(3 * i - 50, i, -i), T(0.1 + i));
    auto handle = builder.getHandle(1.0, nanovdb::Vec3d(0), "density");
    nanovdb::io::writeGrid(name, handle);
}
int main() { write<double>("double.nvdb"); write<int>("int.nvdb"); }
"""


def write_types(folder: Path) -> None:
    """Write double.nvdb and int.nvdb with NanoVDB, and convert them to double.vdb and int.vdb."""
    (folder / "types.cpp").write_text(_TYPES)
    command = ["g++", "-std=c++17", "-w", "types.cpp", "-o", "types"]
    if subprocess.run(command, cwd=folder, capture_output=True, check=False).returncode:
        pytest.skip("no g++ or NanoVDB headers: `make tools` installs them")
    subprocess.run(["./types"], cwd=folder, check=True, timeout=60)
    for name in ("double", "int"):
        subprocess.run(["nanovdb_convert", f"{name}.nvdb", f"{name}.vdb"], cwd=folder, check=True, capture_output=True)
