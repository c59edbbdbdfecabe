#!/usr/bin/env bash
# splat-transform 2.7.1 and 3.7.0: --translate 1,2,3 moves the splats of a .ply by -1, -2, 3.
#
# The program works in PlayCanvas' axes, which are half a turn about z from a .ply of 3DGS, and turns back when it
# writes a .ply. Its help says "Translate Gaussians by (x, y, z)", and nothing about axes. What goes in and what comes
# out have the same axes, but what a user states in between has others: a translation changes two signs, a rotation
# about x or y turns the other way, and a box or a sphere keeps the splats of the other side. Even --filter-value, which
# compares a column by its name, keeps the splats whose x is below 0 if it is asked for those above.
#
# Seen on 2026-11-28 with both versions (x, y, z of what is left of splats at 4, 5, 6 and -4, -5, 6):
#   --translate 1,2,3: [[3, 3, 9], [-5, -7, 9]]
#   --rotate 90,0,0: [[4, 6, -5], [-4, 6, 5]]     (90 degrees about x make [4, -6, 5] of the first)
#   --filter-box 0,0,0,9,9,9: [[-4, -5, 6]]
#   --filter-value x,gt,0: [[-4, -5, 6]]
#
# A box of nerfbake is in the axes of the file that is read.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cp "$(dirname "$0")/splat_rows.py" "$folder"
cd "$folder"
python3 -m venv venv
venv/bin/pip install -q --disable-pip-version-check numpy==2.4.6
for version in 2.7.1 3.7.0; do
	mkdir $version
	(cd $version && npm init -y >/dev/null && npm install --silent --no-audit --no-fund @playcanvas/splat-transform@$version)
done
venv/bin/python - <<'PYTHON'
import subprocess

from splat_rows import read, write

SEEN = {
    "--translate 1,2,3": [[3, 3, 9], [-5, -7, 9]],
    "--rotate 90,0,0": [[4, 6, -5], [-4, 6, 5]],
    "--filter-box 0,0,0,9,9,9": [[-4, -5, 6]],
    "--filter-value x,gt,0": [[-4, -5, 6]],
}
write("in.ply", (4, 5, 6, 0), (-4, -5, 6, 0))
for version in ("2.7.1", "3.7.0"):
    print(version)
    for words, seen in SEEN.items():
        program = f"{version}/node_modules/.bin/splat-transform"
        subprocess.run([program, "-w", "in.ply", *words.split(), "out.ply"], check=True, capture_output=True)
        splats = read("out.ply")
        rows = zip(*(splats[name] for name in "xyz"), strict=True)
        places = [[round(float(each)) for each in row] for row in rows]
        print(f"  {words}: {places}")
        assert places == seen
PYTHON
