#!/usr/bin/env bash
# xuvdb 1.4.0, OpenVDB 10.0.1: a constant block of 8 voxels becomes one of 128, and a turned grid turns the other way.
#
# xuvdb is a young library of sparse volumes, with its own reader and writer of .vdb for the exchange with OpenVDB. That
# stores a block of equal voxels as one tile, 8, 128 or 4,096 voxels wide. xuvdb fills 128 voxels for each of them: a
# volume grows into what was empty, or loses all but a corner. Where OpenVDB compresses a table of floats without any
# value, it writes a length of 0, which xuvdb does not expect: most files of floats end with a ValueError. Those of half
# floats have no such length and are read, with larger tiles. OpenVDB multiplies a row with a matrix, so its translation
# is the last row. xuvdb writes the transposed matrix: for OpenVDB the grid turns the other way, about the origin, and
# has lost its place. Each library reads its own files.
# Guess: tiles and matrices survive, since the tests of such a reader begin with files of OpenVDB.
#
# Seen on 2026-11-28 (voxels by OpenVDB, by xuvdb; then where voxel 2, 0, 0 of a turned grid of xuvdb's is):
#   a cube of 128 and a block of 8 beside it: 2097664, 4194304
#   a cube of 4096: 68719476736, 2097152
#   two blocks of 8 and 12 voxels, half floats: 1036, 2228224
#   3,000 single voxels: 2930, ValueError: truncated .vdb stream
#   voxel 2, 0, 0 by xuvdb: [1.88, 2.48, 3.0], by OpenVDB: [0.88, -0.48, 0.0]
#
# nerfbake reads tiles of all sizes and the length of an empty table, and its .vdb files are compared with OpenVDB.
# Needs OpenVDB for Debian's own Python (Debian 12: python3-openvdb).
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install -q --disable-pip-version-check xuvdb==1.4.0 blosc==1.11.4 numpy==2.4.6 2>/dev/null
/usr/bin/python3 - >openvdb.json <<'PYTHON'
import json
import random

import pyopenvdb as openvdb

CUBE, BLOCK = ((0, 0, 0), (127,) * 3), ((128, 0, 0), (135, 7, 7))
found = {}
for name, boxes in (
    ("beside", (CUBE, BLOCK)),
    ("large", (((0, 0, 0), (4095,) * 3),)),
    ("half", (((0, 0, 0), (15, 7, 7)), ((16, 0, 0), (17, 1, 2)))),
    ("single", ()),
):
    grid = openvdb.FloatGrid(0.0)
    grid.name = "density"
    grid.saveFloatAsHalf = name == "half"
    for low, high in boxes:
        grid.fill(low, high, 1.0)
    if name == "single":
        voxels, chance = grid.getAccessor(), random.Random(1)
        for _ in range(3000):
            voxels.setValueOn(tuple(chance.randrange(40) for _ in range(3)), chance.random())
    openvdb.write(f"{name}.vdb", grids=[grid])
    found[name] = openvdb.readAll(f"{name}.vdb")[0][0].activeVoxelCount()
print(json.dumps(found))
PYTHON
venv/bin/python - >log <<'PYTHON'
import json
from math import cos, sin
from pathlib import Path

import numpy as np
from xuvdb import VdbGrid, openvdb_file


def count(path):
    try:
        return openvdb_file.read_vdb(path)[0].active_voxel_count
    except ValueError as error:
        return f"ValueError: {error}"


found = {name: count(f"{name}.vdb") for name in ("beside", "large", "half", "single")}
turn = np.array([[cos(0.5), -sin(0.5), 0], [sin(0.5), cos(0.5), 0], [0, 0, 1]])
grid = VdbGrid(background=0.0, voxel_size=0.5, name="density", rotation=turn, origin_world=(1, 2, 3))
grid.set_value((2, 0, 0), 1.0)
openvdb_file.write_vdb("turned.vdb", [grid])
again = openvdb_file.read_vdb("turned.vdb")[0]
found["turned"] = again.index_to_world(np.array([[2, 0, 0]]))[0].round(2).tolist()
Path("xuvdb.json").write_text(json.dumps(found))
PYTHON
/usr/bin/python3 - <<'PYTHON'
import json
from pathlib import Path

import pyopenvdb as openvdb

real, seen = (json.loads(Path(f"{name}.json").read_text()) for name in ("openvdb", "xuvdb"))
for name, words, expected in (
    ("beside", "a cube of 128 and a block of 8 beside it", (2097664, 4194304)),
    ("large", "a cube of 4096", (4096**3, 128**3)),
    ("half", "two blocks of 8 and 12 voxels, half floats", (1036, 2228224)),
    ("single", "3,000 single voxels", (2930, "ValueError: truncated .vdb stream")),
):
    print(f"{words}: {real[name]}, {seen[name]}")
    assert (real[name], seen[name]) == expected
grid = openvdb.readAll("turned.vdb")[0][0]
place = [round(number, 2) for number in grid.transform.indexToWorld((2, 0, 0))]
print(f"voxel 2, 0, 0 by xuvdb: {seen['turned']}, by OpenVDB: {place}")
assert (seen["turned"], place) == ([1.88, 2.48, 3.0], [0.88, -0.48, 0.0])
PYTHON
