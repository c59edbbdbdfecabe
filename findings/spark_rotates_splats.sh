#!/usr/bin/env bash
# Spark 2.2.0: a scene of splats that is turned keeps its harmonics, and each splat turns about an axis of its own.
#
# transcodeSpz() writes splats of any format into a .spz, and takes a scale, a rotation and a translation for each
# input. The rotation moves the centres, as it should. It is multiplied with the rotation of a splat in the wrong order:
# the long splat below, which points up, must still point up after a quarter turn about the vertical, and lies down. The
# harmonics, which say in which direction a splat has which colour, are not rotated at all. A test with round splats of
# one colour finds neither. splat-transform 3.7.0 turns all three.
#
# Seen on 2026-11-28 (a quarter turn about z; of harmonics the three of degree 1 for red, in the order y, z, x):
#   before: centre [1, 0, 0], long axis z, harmonics [0.0, 0.0, 0.5]
#   splat-transform: centre [0, 1, 0], long axis z, harmonics [0.5, 0.0, 0.0]
#   Spark: centre [0, 1, 0], long axis x, harmonics [0.0, 0.0, 0.5]
#
# nerfbake turns all three together; a test compares centres, ellipsoids and colours of random directions.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install -q --disable-pip-version-check numpy==2.4.6
npm init -y >/dev/null
npm install --silent --no-audit --no-fund @sparkjsdev/spark@2.2.0 three@0.180.0 @playcanvas/splat-transform@3.7.0
cat >turn.mjs <<'JAVASCRIPT'
import { readFileSync, writeFileSync } from "fs";
import { setTimeout } from "timers/promises";

globalThis.window = globalThis;
const { transcodeSpz } = await import("@sparkjsdev/spark");
const half = Math.SQRT1_2;
const inputs = [{ fileBytes: readFileSync("in.ply"), transform: { quaternion: [0, 0, half, half] } }];
for (let tries = 0; ; tries++) {
  try {
    writeFileSync("spark.spz", (await transcodeSpz({ inputs })).fileBytes);
    break;
  } catch (error) {
    if (tries > 100) throw error; // its WebAssembly is compiled in the background
    await setTimeout(100);
  }
}
process.exit();
JAVASCRIPT
cat >splats.py <<'PYTHON'
import sys
from pathlib import Path

import numpy as np

NAMES = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", *(f"f_rest_{i}" for i in range(45)), "opacity"]
NAMES += ["scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]


def write(path):
    """Long in its own y; a quarter turn about x makes that z. Red depends on x."""
    splat = dict.fromkeys(NAMES, 0.0)
    splat.update(x=1, opacity=2, f_rest_2=0.5, scale_0=-4, scale_1=-1, scale_2=-4, rot_0=0.5**0.5, rot_1=0.5**0.5)
    head = "ply\nformat binary_little_endian 1.0\nelement vertex 1\n"
    head += "".join(f"property float {name}\n" for name in NAMES) + "end_header\n"
    Path(path).write_bytes(head.encode() + np.array(list(splat.values()), "<f4").tobytes())


def describe(path):
    head, _, body = Path(path).read_bytes().partition(b"end_header\n")
    names = [line.split()[-1] for line in head.decode().splitlines() if line.startswith("property")]
    splat = dict(zip(names, np.frombuffer(body, "<f4").tolist(), strict=True))
    turn = np.array([splat[f"rot_{i}"] for i in range(4)])
    w, x, y, z = turn / np.linalg.norm(turn)
    long = [2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)]  # where the splat's own y points
    centre = [round(splat[name]) for name in "xyz"]
    harmonics = [abs(round(splat[f"f_rest_{i}"], 1)) for i in range(3)]
    return f"centre {centre}, long axis {'xyz'[np.argmax(np.abs(long))]}, harmonics {harmonics}"


if __name__ == "__main__":
    write("in.ply")
PYTHON
venv/bin/python splats.py
node turn.mjs
node_modules/.bin/splat-transform -w spark.spz spark.ply >log 2>&1
node_modules/.bin/splat-transform -w in.ply -r 0,0,90 other.ply >log 2>&1
venv/bin/python - <<'PYTHON'
from splats import describe

files = {"before": "in.ply", "splat-transform": "other.ply", "Spark": "spark.ply"}
found = {name: describe(path) for name, path in files.items()}
for name, words in found.items():
    print(f"{name}: {words}")
assert found["before"] == "centre [1, 0, 0], long axis z, harmonics [0.0, 0.0, 0.5]"
assert found["splat-transform"] == "centre [0, 1, 0], long axis z, harmonics [0.5, 0.0, 0.0]"
assert found["Spark"] == "centre [0, 1, 0], long axis x, harmonics [0.0, 0.0, 0.5]"
PYTHON
