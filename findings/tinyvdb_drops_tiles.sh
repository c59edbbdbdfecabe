#!/usr/bin/env bash
# tinyvdb 0.9.0: of a volume that OpenVDB wrote, only single voxels are read; its constant blocks come out empty.
#
# OpenVDB stores a block of equal voxels as one value, a tile: 8, 128 or 4,096 voxels wide. to_sparse(), which is to
# extract the active voxels, and materialize_dense() leave tiles out: a solid cube of 20 voxels becomes a shell, one of
# 128 nothing at all, while the metadata of the same grid still tell the right count. In materialize_dense(), all that
# is no active voxel is 0, also where the background is another value: around the sphere of a level set, everything that
# is far outside or deep inside lies on the surface. No error, no warning.
# Needs OpenVDB's module for Python (Debian: python3-openvdb).
#
# Seen on 2026-11-28 (active voxels and their sum: OpenVDB; the file's metadata; to_sparse(); materialize_dense()):
#   solid cube, 20 wide: 8000 8000.0; 8000; 3904 3904.0; 3904.0
#   solid cube, 128 wide: 2097152 2097152.0; 2097152; 0 0.0; 0.0
# and of a level set, 40 voxels away from a sphere: OpenVDB 3.0, tinyvdb 0.0
#
# nerfbake reads tiles and backgrounds; `nerfbake info` counts tiles and their voxels.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install -q --disable-pip-version-check tinyvdb==0.9.0 numpy==2.4.6 2>/dev/null
/usr/bin/python3 - >openvdb.json <<'PYTHON'
import json

import numpy as np
import pyopenvdb as openvdb

seen = {}
for width in (20, 128):
    grid = openvdb.FloatGrid(0.0)
    grid.name = "density"
    grid.fill((0, 0, 0), (width - 1,) * 3, 1.0)
    openvdb.write(f"{width}.vdb", grids=[grid])
    dense = np.zeros((width,) * 3, np.float32)
    grid.copyToArray(dense)
    seen[width] = (grid.activeVoxelCount(), float(dense.sum()))
grid = openvdb.createLevelSetSphere(radius=20.0, voxelSize=1.0, halfWidth=3.0)
openvdb.write("sphere.vdb", grids=[grid])
seen["sphere"] = grid.getConstAccessor().getValue((60, 0, 0))
print(json.dumps(seen))
PYTHON
venv/bin/python - <<'PYTHON'
import json
from pathlib import Path

import numpy as np
import tinyvdb


def dense(path, low, high):
    with tinyvdb.open(path) as file:
        file.read_grids()
        grid = file.grid(0)
        voxels, box = grid.to_sparse(), grid.materialize_dense(low, high)
        return grid.metadata["file_voxel_count"], voxels, np.frombuffer(box.to_bytes(), np.float32)


real = json.loads(Path("openvdb.json").read_text())
for width, read in ((20, 3904), (128, 0)):
    told, voxels, box = dense(f"{width}.vdb", (0, 0, 0), (width,) * 3)
    active, total = real[str(width)]
    alone = float(np.frombuffer(voxels["values"], np.float32).sum())
    print(f"solid cube, {width} wide: {active} {total}; {told}; {voxels['count']} {alone}; {float(box.sum())}")
    assert active == total == told == width**3 and voxels["count"] == alone == box.sum() == read
away = float(dense("sphere.vdb", (60, 0, 0), (61, 1, 1))[2][0])
print(f"and of a level set, 40 voxels away from a sphere: OpenVDB {real['sphere']}, tinyvdb {away}")
assert (real["sphere"], away) == (3.0, 0.0)
PYTHON
