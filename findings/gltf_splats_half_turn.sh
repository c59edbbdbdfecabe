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
cd "$folder"
cat >rows.py <<'PYTHON'
import numpy as np

NAMES = "x y z nx ny nz f_dc_0 f_dc_1 f_dc_2 opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3".split()


def write(path, *rows):
    """Write a .ply of 3DGS. rows: x, y, z and the logit of the opacity of each splat."""
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(rows)}\n"
    head += "".join(f"property float {name}\n" for name in NAMES) + "end_header\n"
    table = np.array([[*row[:3], 0, 0, 0, 0.1, 0.2, 0.3, row[3], -3, -3, -3, 1, 0, 0, 0] for row in rows], "<f4")
    open(path, "wb").write(head.encode() + table.tobytes())


def read(path):
    """Return the columns of a .ply by name."""
    head, _, body = open(path, "rb").read().partition(b"end_header\n")
    names = [line.split()[-1] for line in head.decode().splitlines() if line.startswith("property")]
    return dict(zip(names, np.frombuffer(body, "<f4").reshape(-1, len(names)).T, strict=True))

PYTHON
python3 -m venv venv
venv/bin/pip install -q --disable-pip-version-check numpy==2.4.6 gaussforge==0.6.0
npm init -y >/dev/null
npm install --silent --no-audit --no-fund @playcanvas/splat-transform@3.7.0
venv/bin/python -c 'from rows import write; write("in.ply", (1, 2, 3, 0))'
for ending in spz glb; do node_modules/.bin/splat-transform -w in.ply out.$ending >log 2>&1; done
venv/bin/python - <<'PYTHON' 2>log
import json

import gaussforge
import numpy as np
from rows import read

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
