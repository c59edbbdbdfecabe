#!/usr/bin/env bash
# splat-transform 3.7.0: the rotations of a .glb of splats have the length that training left, not 1.
#
# A .ply of 3DGS holds quaternions before they are normalised, and their lengths differ from splat to splat.
# KHR_gaussian_splatting wants unit quaternions, and its formula of the rotation matrix is right for these alone.
# splat-transform copies the four numbers. Its .spz, and those of gaussforge and gsply, have unit quaternions, because
# they do not store the length. A reader that takes the extension at its word builds a matrix that stretches or shrinks
# the splat. three.js 0.187.0 normalises again.
#
# Seen on 2026-11-28 (length of the quaternion in the .ply and in the .glb; lengths of the columns of its matrix, by the
# formula of the extension):
#   1.0 1.0 [1. 1. 1.]
#   2.0 2.0 [7. 5. 5.]
#   0.5 0.5 [0.5  0.79 0.79]
#
# nerfbake normalises the rotations of the splats that it reads, and `nerfbake check` names such a .glb.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cp "$(dirname "$0")/splat_rows.py" "$folder"
cd "$folder"
python3 -m venv venv
venv/bin/pip install -q --disable-pip-version-check numpy==2.4.6 plyfile==1.1.5
npm init -y >/dev/null
npm install --silent --no-audit --no-fund @playcanvas/splat-transform@3.7.0
cat >run.py <<'PYTHON'
import json
import subprocess

import numpy as np
from plyfile import PlyData
from splat_rows import write

write("unit.ply", *((x, 0, 0, 2) for x in (1, 2, 3)))
ply = PlyData.read("unit.ply")
lengths = np.array([1, 2, 0.5])
for column in ("rot_0", "rot_1"):  # w and x: 90 degrees about x
    ply["vertex"][column] = lengths * np.sqrt(0.5)
ply.write("in.ply")
subprocess.run(["node_modules/.bin/splat-transform", "-w", "in.ply", "out.glb"], capture_output=True, check=True)
data = open("out.glb", "rb").read()
size = int.from_bytes(data[12:16], "little")
document = json.loads(data[20 : 20 + size])
attributes = document["meshes"][0]["primitives"][0]["attributes"]


def column(name, width):
    accessor = document["accessors"][attributes[name]]
    assert accessor["componentType"] == 5126
    view = document["bufferViews"][accessor["bufferView"]]
    place = 28 + size + view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
    return np.frombuffer(data, "<f4", 3 * width, place).reshape(3, width)


turns = column("KHR_gaussian_splatting:ROTATION", 4)[np.argsort(-column("POSITION", 3)[:, 0])]
found = []
for length, (x, y, z, w) in zip(lengths, turns, strict=True):
    matrix = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    found.append(round(float(np.linalg.norm((x, y, z, w))), 4))
    print(length, found[-1], np.linalg.norm(matrix, axis=0).round(2))
assert found == lengths.tolist()
PYTHON
venv/bin/python run.py
