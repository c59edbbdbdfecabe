#!/usr/bin/env bash
# gaussforge 0.6.0 (SPZ's own library) and splat-transform 3.7.0: positions beyond 2,048 change their sign in a .spz.
#
# A .spz stores positions in 24 bits; both programs put the point behind 12 of them, whatever the scene is, although
# the header has a field for that number. 2,049 is stored as -2,047 and -5,000 as -904, and neither program says so. A
# city in metres, or a room in millimetres, folds into itself.
#
# Seen on 2026-11-27, both programs alike:
#   x of the .ply: [1.0, 2047.0, 2049.0, -5000.0]
#   x of the .spz: [1.0, 2047.0, -2047.0, -904.0]
#
# nerfbake chooses the number of bits by the largest coordinate, and refuses what does not fit.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cp "$(dirname "$0")/splat_rows.py" "$folder"
cd "$folder"
python3 -m venv venv
venv/bin/pip install -q --disable-pip-version-check gaussforge==0.6.0 numpy==2.4.6
npm init -y >/dev/null
npm install --silent --no-audit --no-fund @playcanvas/splat-transform@3.7.0
venv/bin/python -c 'from splat_rows import write; write("in.ply", *((x, 0, 0, 0) for x in (1, 2047, 2049, -5000)))'
node_modules/.bin/splat-transform -w in.ply a.spz >log 2>&1
node_modules/.bin/splat-transform -w a.spz a.ply >log 2>&1
venv/bin/python - <<'PYTHON' 2>log
import gaussforge
from splat_rows import read

given = read("in.ply")["x"].tolist()
print(f"x of the .ply: {given}")
forge = gaussforge.GaussForge()
packed = forge.convert(open("in.ply", "rb").read(), "ply", "spz")["data"]
open("b.ply", "wb").write(forge.convert(packed, "spz", "ply")["data"])
for program, path in (("splat-transform", "a.ply"), ("gaussforge", "b.ply")):
    found = read(path)["x"].tolist()
    print(f"x of the .spz: {found} ({program})")
    assert found == [1, 2047, -2047, -904]
PYTHON
