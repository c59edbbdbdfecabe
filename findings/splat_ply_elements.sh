#!/usr/bin/env bash
# gsply 0.4.6, splat-transform 3.7.0, Babylon.js 9.35.0: a camera in the .ply of splats shifts the splats.
#
# A .ply has elements, each with a number of rows, in any order. Apple's SHARP, for instance, puts seven behind the
# splats: extrinsic, intrinsic, image_size, frame, disparity, color_space and version. gsply counts the properties of
# all elements as columns of a splat, so each splat begins further behind its place: the first is right, the others are
# mixtures. If a camera stands before the splats, splat-transform and Babylon.js also take its numbers for the first
# splats, and lose as many at the end. All of them return as many splats as there are, and say nothing. plyfile reads
# all three files.
#
# Seen on 2026-11-28 (x of the splats, which is 1 2 3 4; the numbers of the camera are all 1):
#   splats alone, gsply: [1.0, 2.0, 3.0, 4.0]
#   splats alone, splat-transform: [1.0, 2.0, 3.0, 4.0]
#   splats alone, Babylon.js: [1.0, 2.0, 3.0, 4.0]
#   camera after, gsply: [1.0, 0.0, 0.1, 2.0]
#   camera after, splat-transform: [1.0, 2.0, 3.0, 4.0]
#   camera after, Babylon.js: [1.0, 2.0, 3.0, 4.0]
#   camera before, gsply: [1.0, 1.0, -3.0, 0.0]
#   camera before, splat-transform: [1.0, 1.0, 0.0, 0.0]
#   camera before, Babylon.js: [1.0, 1.0, 0.0, 0.0]
#
# nerfbake reads each element where the header puts it.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cp "$(dirname "$0")/splat_rows.py" "$folder"
cd "$folder"
python3 -m venv venv
venv/bin/pip install -q --disable-pip-version-check gsply==0.4.6 numpy==2.4.6 plyfile==1.1.5
npm init -y >/dev/null
npm install --silent --no-audit --no-fund @playcanvas/splat-transform@3.7.0 @babylonjs/core@9.35.0
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
venv/bin/python - <<'PYTHON'
import json
import subprocess

import gsply
import numpy as np
from plyfile import PlyData, PlyElement
from splat_rows import read, write


def run(*words):
    return subprocess.run(words, check=True, capture_output=True, text=True).stdout


def by_splat_transform(path):
    run("node_modules/.bin/splat-transform", "-w", path, "out.ply")
    return read("out.ply")["x"]


READERS = {
    "gsply": lambda path: np.asarray(gsply.plyread(path).means)[:, 0],
    "splat-transform": by_splat_transform,
    "Babylon.js": lambda path: json.loads(run("node", "babylon.mjs", path).split("x ")[-1]),
}
write("alone.ply", *((x, 0, 0, 2) for x in (1, 2, 3, 4)))
splats = PlyData.read("alone.ply")["vertex"]
others = {"extrinsic": ("f4", 16), "intrinsic": ("f4", 9), "image_size": ("u4", 2), "frame": ("i4", 2)}
others |= {"disparity": ("f4", 2), "color_space": ("u1", 1), "version": ("u1", 3)}
cameras = [PlyElement.describe(np.ones(count, [(name, kind)]), name) for name, (kind, count) in others.items()]
PlyData([splats, *cameras]).write("after.ply")
PlyData([*cameras, splats]).write("before.ply")
found = {}
for name, path in (("splats alone", "alone.ply"), ("camera after", "after.ply"), ("camera before", "before.ply")):
    assert PlyData.read(path)["vertex"]["x"].tolist() == [1, 2, 3, 4]
    for reader, function in READERS.items():
        found[name, reader] = [round(float(x), 2) for x in function(path)]
        print(f"{name}, {reader}: {found[name, reader]}")
right = [key for key, places in found.items() if places == [1, 2, 3, 4]]
assert right[:3] == [("splats alone", reader) for reader in READERS]
assert right[3:] == [("camera after", "splat-transform"), ("camera after", "Babylon.js")]
assert found["camera after", "gsply"] == [1, 0, 0.1, 2]
assert found["camera before", "splat-transform"] == found["camera before", "Babylon.js"] == [1, 1, 0, 0]
PYTHON
