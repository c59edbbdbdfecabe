#!/usr/bin/env bash
# ply2splat 0.6.0, gaussian-splats-3d 0.4.7, Babylon.js 9.35.0: splats in doubles or in float32 are at 0, 0, 0 or NaN.
#
# pymeshlab writes the places of points as doubles, and NumPy makes doubles of everything unless it is told otherwise.
# The header of a .ply states the type of each column. ply2splat takes a column of doubles for absent, and puts all
# splats at 0, 0, 0. gaussian-splats-3d does the same without a default, so their places are NaN. Babylon.js knows
# doubles, but not float32, which is another name of float in a .ply: it also puts all splats at 0, 0, 0. None of them
# says a word. plyfile reads all three files, and splat-transform 3.7.0 reads doubles and refuses float32.
#
# Seen on 2026-11-28 (x of the splats, which is 1 2 3 4; null is JSON for NaN):
#   floats, ply2splat: [1.0, 2.0, 3.0, 4.0]
#   floats, gaussian-splats-3d: [1, 2, 3, 4]
#   floats, Babylon.js: [1, 2, 3, 4]
#   places in doubles, ply2splat: [0.0, 0.0, 0.0, 0.0]
#   places in doubles, gaussian-splats-3d: [null, null, null, null]
#   places in doubles, Babylon.js: [1, 2, 3, 4]
#   float32, ply2splat: [1.0, 2.0, 3.0, 4.0]
#   float32, gaussian-splats-3d: [null, null, null, null]
#   float32, Babylon.js: [0, 0, 0, 0]
#
# nerfbake reads doubles, and both names of all types.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cp "$(dirname "$0")/splat_rows.py" "$folder"
cd "$folder"
python3 -m venv venv
venv/bin/pip install -q --disable-pip-version-check numpy==2.4.6 plyfile==1.1.5 ply2splat==0.6.0
npm init -y >/dev/null
npm install --silent --no-audit --no-fund @babylonjs/core@9.35.0 @mkkellogg/gaussian-splats-3d@0.4.7 three@0.187.0
cat >babylon.mjs <<'JAVASCRIPT'
import { readFileSync } from "fs";
import { NullEngine } from "@babylonjs/core/Engines/nullEngine.js";
import { GaussianSplattingMesh } from "@babylonjs/core/Meshes/GaussianSplatting/gaussianSplattingMesh.js";

new NullEngine();
const ply = new Uint8Array(readFileSync(process.argv[2])).buffer;
const { buffer } = await GaussianSplattingMesh.ConvertPLYWithSHToSplatAsync(ply);
console.log("x " + JSON.stringify(Array.from(new Float32Array(buffer)).filter((_, i) => i % 8 === 0)));
process.exit();
JAVASCRIPT
cat >kellogg.mjs <<'JAVASCRIPT'
import { readFileSync } from "fs";
import { Vector3 } from "three";
import { PlyLoader } from "./node_modules/@mkkellogg/gaussian-splats-3d/build/gaussian-splats-3d.module.js";

globalThis.window = globalThis;
const splats = await PlyLoader.loadFromFileData(new Uint8Array(readFileSync(process.argv[2])).buffer, 1, 0, false, 0);
const places = Array.from({ length: splats.getSplatCount() }, () => new Vector3());
places.forEach((place, i) => splats.getSplatCenter(i, place));
console.log("x " + JSON.stringify(places.map((place) => place.x)));
JAVASCRIPT
venv/bin/python - <<'PYTHON'
import json
import subprocess
from pathlib import Path

import numpy as np
import ply2splat
from plyfile import PlyData, PlyElement
from splat_rows import write


def by_ply2splat(path):
    assert ply2splat.convert(path, "out.splat", sort=False) == 4
    return np.fromfile("out.splat", "<f4").reshape(4, 8)[:, 0].tolist()


def run(*words):
    said = subprocess.run(words, check=True, capture_output=True, text=True).stdout
    return json.loads(said.split("x ")[-1])


READERS = {
    "ply2splat": by_ply2splat,
    "gaussian-splats-3d": lambda path: run("node", "kellogg.mjs", path),
    "Babylon.js": lambda path: run("node", "babylon.mjs", path),
}
write("floats.ply", *((x, 0, 0, 2) for x in (1, 2, 3, 4)))
splats = PlyData.read("floats.ply")["vertex"].data
mixed = splats.astype([(name, "f8" if name in ("x", "y", "z") else "f4") for name in splats.dtype.names])
PlyData([PlyElement.describe(mixed, "vertex")]).write("doubles.ply")
Path("float32.ply").write_bytes(Path("floats.ply").read_bytes().replace(b"property float ", b"property float32 "))
RIGHT, ZERO, NAN = [1, 2, 3, 4], [0] * 4, [None] * 4
for name, path, *seen in (
    ("floats", "floats.ply", RIGHT, RIGHT, RIGHT),
    ("places in doubles", "doubles.ply", ZERO, NAN, RIGHT),
    ("float32", "float32.ply", RIGHT, NAN, ZERO),
):
    assert PlyData.read(path)["vertex"]["x"].tolist() == RIGHT
    for (reader, function), expected in zip(READERS.items(), seen, strict=True):
        found = function(path)
        print(f"{name}, {reader}: {json.dumps(found)}")
        assert found == expected
PYTHON
