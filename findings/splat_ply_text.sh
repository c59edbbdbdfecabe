#!/usr/bin/env bash
# splat-transform 3.7.0: a .ply of splats in text, or in big endian, is read as if it were binary and little endian.
#
# All three encodings of a .ply are valid, and plyfile writes each of them. The header says which one it is, but
# splat-transform looks at the names of the properties alone: it converts the digits of the text as if they were
# floats. It exits with 0, says how many Gaussians it wrote, and prints no warning.
#
# Seen on 2026-11-28 (x of the .ply that splat-transform wrote; it is 1 2 3 4):
#   little endian: [1.0, 2.0, 3.0, 4.0]
#   text: [1.49e-19, 0.000176, 4.42e-05, 6.41e-10]
#   big endian: [4.6e-41, 8.97e-44, 2.3e-41, 4.6e-41]
#
# nerfbake reads the three of them alike.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cp "$(dirname "$0")/splat_rows.py" "$folder"
cd "$folder"
python3 -m venv venv
venv/bin/pip install -q --disable-pip-version-check numpy==2.4.6 plyfile==1.1.5
npm init -y >/dev/null
npm install --silent --no-audit --no-fund @playcanvas/splat-transform@3.7.0
venv/bin/python - <<'PYTHON'
import subprocess

import numpy as np
from plyfile import PlyData
from splat_rows import read, write

write("little.ply", *((x, 0, 0, 2) for x in (1, 2, 3, 4)))
vertices = PlyData.read("little.ply")["vertex"]
PlyData([vertices], text=True).write("text.ply")
PlyData([vertices], byte_order=">").write("big.ply")
for name, path in (("little endian", "little.ply"), ("text", "text.ply"), ("big endian", "big.ply")):
    assert PlyData.read(path)["vertex"]["x"].tolist() == [1, 2, 3, 4]
    done = subprocess.run(
        ["node_modules/.bin/splat-transform", "-w", path, "out.ply"], capture_output=True, text=True, timeout=60
    )
    said = (done.stdout + done.stderr).lower()
    assert done.returncode == 0 and "4 gaussians" in said and "warn" not in said and "error" not in said
    found = read("out.ply")["x"]
    print(f"{name}: {[float(f'{x:.3g}') for x in found]}")
    assert (np.abs(found).max() == 4) if path == "little.ply" else (np.abs(found).max() < 0.001)
PYTHON
