#!/usr/bin/env bash
# splat-transform 3.7.0: the .glb of splats is turned by 180 degrees about z, the .spz of the same .ply is not at all.
#
# Splats of 3DGS have -y up and look along z. glTF has y up, and the front of a scene looks along +z: splat-transform
# writes (1, 2, 3) as (-1, -2, 3) to a .glb. SPZ's README says that its axes are right, up and back, which would be
# (1, -2, -3), but the .spz has (1, 2, 3). So its two exchange formats differ by this half turn, and a viewer that is
# right for one of them shows the other upside down.
#
# Seen on 2026-11-27:
#   .ply [1, 2, 3]
#   .glb [-1, -2, 3]
#   .spz [1, 2, 3]
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cp "$(dirname "$0")/splat_rows.py" "$folder"
cd "$folder"
python3 -m venv venv
venv/bin/pip install -q --disable-pip-version-check numpy==2.4.6 gaussforge==0.6.0
npm init -y >/dev/null
npm install --silent --no-audit --no-fund @playcanvas/splat-transform@3.7.0
venv/bin/python -c 'from splat_rows import write; write("in.ply", (1, 2, 3, 0))'
for ending in spz glb; do node_modules/.bin/splat-transform -w in.ply out.$ending >log 2>&1; done
venv/bin/python - <<'PYTHON' 2>log
import json

import gaussforge
import numpy as np
from splat_rows import read

data = open("out.glb", "rb").read()
size = int.from_bytes(data[12:16], "little")
document = json.loads(data[20 : 20 + size])
accessor = document["accessors"][document["meshes"][0]["primitives"][0]["attributes"]["POSITION"]]
view = document["bufferViews"][accessor["bufferView"]]
place = 28 + size + view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
turned = np.rint(np.frombuffer(data, "<f4", 3, place)).astype(int).tolist()
# gaussforge turns nothing between .spz and .ply: it shows the numbers as they are stored.
open("out.ply", "wb").write(gaussforge.GaussForge().convert(open("out.spz", "rb").read(), "spz", "ply")["data"])
stored = read("out.ply")
plain = [round(float(stored[axis][0])) for axis in "xyz"]
print(f".ply [1, 2, 3]\n.glb {turned}\n.spz {plain}")
assert "matrix" not in document["nodes"][0] and "rotation" not in document["nodes"][0]
assert turned == [-1, -2, 3] and plain == [1, 2, 3]
PYTHON
