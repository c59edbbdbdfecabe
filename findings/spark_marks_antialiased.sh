#!/usr/bin/env bash
# Spark 2.2.0: every .spz that it writes says that its splats were trained with antialiasing.
#
# A .spz has a flag for this, since such splats are drawn in another way: a splat that is smaller than a pixel is made
# larger, and fainter to the same degree. transcodeSpz() has no option for the flag and sets it always, whether its
# source has no such statement or the opposite one. So scenes of plain 3DGS lose their fine parts in viewers that obey
# the flag, and splat-transform 3.7.0 carries it on: the .ply that it makes of the .spz is declared as one of
# Mip-Splatting.
#
# Seen on 2026-11-28 (the lowest bit of the flags in the header, and what a .ply made of the file declares):
#   .spz of gaussforge: 0, no SplatRenderMode
#   .spz of Spark, from the same .ply: 1, SplatRenderMode: mip
#   .spz of Spark, from gaussforge's: 1, SplatRenderMode: mip
#
# nerfbake sets the flag for splats that were trained so, and draws the splats of a .spz as it says.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install -q --disable-pip-version-check gaussforge==0.6.0 numpy==2.4.6
npm init -y >/dev/null
npm install --silent --no-audit --no-fund @sparkjsdev/spark@2.2.0 three@0.180.0 @playcanvas/splat-transform@3.7.0
cat >spark.mjs <<'JAVASCRIPT'
import { readFileSync, writeFileSync } from "fs";
import { setTimeout } from "timers/promises";

globalThis.window = globalThis;
const { transcodeSpz } = await import("@sparkjsdev/spark");
const inputs = [{ fileBytes: readFileSync(process.argv[2]), pathOrUrl: process.argv[2] }];
for (let tries = 0; ; tries++) {
  try {
    writeFileSync(process.argv[3], (await transcodeSpz({ inputs })).fileBytes);
    break;
  } catch (error) {
    if (tries > 100) throw error; // its WebAssembly is compiled in the background
    await setTimeout(100);
  }
}
process.exit();
JAVASCRIPT
venv/bin/python - <<'PYTHON' 2>log
import gzip
import subprocess
from pathlib import Path

import gaussforge
import numpy as np

NAMES = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", *(f"f_rest_{i}" for i in range(45)), "opacity"]
NAMES += ["scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]


def declared(spz):
    flags = gzip.decompress(Path(spz).read_bytes())[14]
    subprocess.run(["node_modules/.bin/splat-transform", "-w", spz, "out.ply"], check=True, capture_output=True)
    lines = Path("out.ply").read_bytes().partition(b"end_header\n")[0].decode().splitlines()
    words = [line.removeprefix("comment ") for line in lines if "SplatRenderMode" in line]
    return f"{flags & 1}, {words[0] if words else 'no SplatRenderMode'}"


splat = dict.fromkeys(NAMES, 0.0)
splat.update(opacity=2, scale_0=-3, scale_1=-3, scale_2=-3, rot_0=1, f_rest_0=0.5)
head = "ply\nformat binary_little_endian 1.0\nelement vertex 1\n"
head += "".join(f"property float {name}\n" for name in NAMES) + "end_header\n"
Path("in.ply").write_bytes(head.encode() + np.array(list(splat.values()), "<f4").tobytes())
Path("other.spz").write_bytes(gaussforge.GaussForge().convert(Path("in.ply").read_bytes(), "ply", "spz")["data"])
subprocess.run(["node", "spark.mjs", "in.ply", "spark.spz"], check=True)
subprocess.run(["node", "spark.mjs", "other.spz", "again.spz"], check=True)
for name, path, seen in (
    (".spz of gaussforge", "other.spz", "0, no SplatRenderMode"),
    (".spz of Spark, from the same .ply", "spark.spz", "1, SplatRenderMode: mip"),
    (".spz of Spark, from gaussforge's", "again.spz", "1, SplatRenderMode: mip"),
):
    found = declared(path)
    print(f"{name}: {found}")
    assert found == seen
PYTHON
