#!/usr/bin/env bash
# gsply 0.4.6 and spz-js 1.2.5: a .ply of splats with three more columns of bytes is read shifted.
#
# Editors of point clouds keep red, green and blue as bytes beside the numbers of 3DGS. The header states the types, and
# plyfile and splat-transform 3.7.0 read such a file. gsply takes every row for floats alone, so each splat begins three
# bytes further from where it should; spz-js asks an array of floats for places between two floats, which are undefined.
# Both return arrays of the right shape without a warning, and the first splat is right.
#
# Seen on 2026-11-28 (x of the splats; it is 1 2 3 4):
#   floats alone, gsply: [1. 2. 3. 4.]
#   floats alone, spz-js: [1,2,3,4]
#   with colours, gsply: [1. 0. 0. 0.]
#   with colours, spz-js: [1,null,null,null]     (JSON for NaN)
#
# nerfbake reads the columns by their types.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cp "$(dirname "$0")/splat_rows.py" "$folder"
cd "$folder"
python3 -m venv venv
venv/bin/pip install -q --disable-pip-version-check gsply==0.4.6 numpy==2.4.6 plyfile==1.1.5
npm init -y >/dev/null
npm install --silent --no-audit --no-fund spz-js@1.2.5
cat >run.mjs <<'JAVASCRIPT'
import { createReadStream } from "fs";
import { loadPly } from "spz-js";
import { Readable } from "stream";

const splats = await loadPly(Readable.toWeb(createReadStream(process.argv[2])));
console.log(JSON.stringify(Array.from(splats.positions).filter((_, i) => i % 3 === 0)));
JAVASCRIPT
venv/bin/python - <<'PYTHON'
import subprocess

import gsply
import numpy as np
from plyfile import PlyData, PlyElement
from splat_rows import write

write("alone.ply", *((x, 0, 0, 2) for x in (1, 2, 3, 4)))
floats = PlyData.read("alone.ply")["vertex"].data
both = np.zeros(4, [*floats.dtype.descr, ("red", "u1"), ("green", "u1"), ("blue", "u1")])
for column in floats.dtype.names:
    both[column] = floats[column]
PlyData([PlyElement.describe(both, "vertex")]).write("colours.ply")
found = {}
for name, path in (("floats alone", "alone.ply"), ("with colours", "colours.ply")):
    assert PlyData.read(path)["vertex"]["x"].tolist() == [1, 2, 3, 4]
    python = np.asarray(gsply.plyread(path).means)[:, 0]
    script = subprocess.run(["node", "run.mjs", path], capture_output=True, text=True, check=True).stdout.strip()
    print(f"{name}, gsply: {python.round(3)}\n{name}, spz-js: {script}")
    found[path] = python.round(3).tolist(), script
assert found["alone.ply"] == ([1, 2, 3, 4], "[1,2,3,4]")
assert found["colours.ply"] == ([1, 0, 0, 0], "[1,null,null,null]")
PYTHON
