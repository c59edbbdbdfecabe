#!/usr/bin/env bash
# gaussforge 0.6.0: harmonics change places in a compressed .ply, and from degree 2 on in a .ksplat.
#
# A .ply of 3DGS holds all coefficients of red, then green, then blue. A compressed .ply has the same order in bytes,
# but gaussforge writes red, green and blue of each coefficient in turn. It reads as the format asks, so it does not
# even get back what it wrote itself. A .ksplat completes each degree before the next: the three colours of degree 1,
# then those of degree 2. gaussforge completes each colour. It gets back what it wrote, but misreads the files of
# gaussian-splats-3d, whose format this is, and writes files that others misread. With degree 1 alone, both orders are
# the same.
#
# Seen on 2026-11-28 (which of the 24 coefficients of degree 2 stands in the place of 0, 1, 2, ...):
#   gaussforge.compressed.ply by splat-transform: 0 8 16 1 9 17 2 10 18 3 11 19 4 12 20 5 13 21 6 14 22 7 15 23
#   gaussforge.compressed.ply by gaussforge: 0 8 16 1 9 17 2 10 18 3 11 19 4 12 20 5 13 21 6 14 22 7 15 23
#   splat-transform.compressed.ply by gaussforge: right
#   gaussforge.ksplat by splat-transform: 0 1 2 9 10 11 12 13 3 4 5 14 15 16 17 18 6 7 8 19 20 21 22 23
#   gaussforge.ksplat by gaussforge: right
#   gaussian-splats-3d.ksplat by splat-transform: right
#   gaussian-splats-3d.ksplat by gaussforge: 0 1 2 8 9 10 16 17 18 3 4 5 6 7 11 12 13 14 15 19 20 21 22 23
#
# nerfbake reads the compressed .ply of splat-transform and the .ksplat of gaussian-splats-3d in the right order.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install -q --disable-pip-version-check gaussforge==0.6.0 numpy==2.4.6
npm init -y >/dev/null
npm install --silent --no-audit --no-fund @playcanvas/splat-transform@3.7.0
npm install --silent --no-audit --no-fund @mkkellogg/gaussian-splats-3d@0.4.7 three@0.187.0
cat >pack.mjs <<'JAVASCRIPT'
import { readFileSync, writeFileSync } from "fs";
import { PlyLoader } from "./node_modules/@mkkellogg/gaussian-splats-3d/build/gaussian-splats-3d.module.js";

globalThis.window = globalThis;
const splats = await PlyLoader.loadFromFileData(new Uint8Array(readFileSync("in.ply")).buffer, 1, 0, false, 2);
writeFileSync("gaussian-splats-3d.ksplat", Buffer.from(splats.bufferData));
JAVASCRIPT
venv/bin/python - <<'PYTHON' 2>log
import subprocess
from pathlib import Path

import gaussforge
import numpy as np

COUNT = 24
NAMES = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", *(f"f_rest_{i}" for i in range(COUNT)), "opacity"]
NAMES += ["scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
forge = gaussforge.GaussForge()


def value(i):
    return (i - 12) / 16  # far enough apart for eight bits


def order(ply):
    """Return which coefficient stands in each place."""
    head, _, body = ply.partition(b"end_header\n")
    names = [line.split()[-1] for line in head.decode().splitlines() if line.startswith("property")]
    splat = dict(zip(names, np.frombuffer(body, "<f4", len(names)).tolist(), strict=True))
    return [round(splat[f"f_rest_{i}"] * 16 + 12) for i in range(COUNT)]


def by_splat_transform(path):
    subprocess.run(["node_modules/.bin/splat-transform", "-w", path, "out.ply"], check=True, capture_output=True)
    return order(Path("out.ply").read_bytes())


def by_gaussforge(path):
    return order(forge.convert(Path(path).read_bytes(), path.partition(".")[2], "ply")["data"])


splat = dict.fromkeys(NAMES, 0.0)
splat.update({f"f_rest_{i}": value(i) for i in range(COUNT)})
splat.update(x=1, opacity=2, scale_0=-3, scale_1=-3, scale_2=-3, rot_0=1)
head = "ply\nformat binary_little_endian 1.0\nelement vertex 2\n"
head += "".join(f"property float {name}\n" for name in NAMES) + "end_header\n"
source = head.encode() + np.array([list(splat.values())] * 2, "<f4").tobytes()
Path("in.ply").write_bytes(source)
for ending in ("compressed.ply", "ksplat"):
    Path(f"gaussforge.{ending}").write_bytes(forge.convert(source, "ply", ending)["data"])
words = ["node_modules/.bin/splat-transform", "-w", "in.ply", "splat-transform.compressed.ply"]
subprocess.run(words, check=True, capture_output=True)
subprocess.run(["node", "pack.mjs"], check=True)

RIGHT = list(range(COUNT))
TURNS = [8 * (i % 3) + i // 3 for i in RIGHT]  # red, green and blue in turn
WRITTEN = [0, 1, 2, 9, 10, 11, 12, 13, 3, 4, 5, 14, 15, 16, 17, 18, 6, 7, 8, 19, 20, 21, 22, 23]
READ = [WRITTEN.index(i) for i in RIGHT]
for path, reader, expected in (
    ("gaussforge.compressed.ply", by_splat_transform, TURNS),
    ("gaussforge.compressed.ply", by_gaussforge, TURNS),
    ("splat-transform.compressed.ply", by_gaussforge, RIGHT),
    ("gaussforge.ksplat", by_splat_transform, WRITTEN),
    ("gaussforge.ksplat", by_gaussforge, RIGHT),
    ("gaussian-splats-3d.ksplat", by_splat_transform, RIGHT),
    ("gaussian-splats-3d.ksplat", by_gaussforge, READ),
):
    found = reader(path)
    program = reader.__name__.removeprefix("by_").replace("_", "-")
    print(f"{path} by {program}: {'right' if found == RIGHT else ' '.join(map(str, found))}")
    assert found == expected
PYTHON
