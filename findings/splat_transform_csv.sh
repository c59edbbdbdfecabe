#!/usr/bin/env bash
# splat-transform 2.7.1 and 3.7.0: splats that are moved, turned or scaled arrive in a .csv where they were before.
#
# --translate, --rotate and --scale apply to the splats, whichever format is written, and a .csv is one of them. The
# program puts off all movement until a file is written, and its writer of .csv leaves it out: the table has the numbers
# of the source. The same command with a .ply does all three. Nothing is said, and the program succeeds. A filter by a
# box or a sphere behind the movement sees the moved splats, so a table has the splats of one place and the numbers of
# another. The sphere below is stated in the axes of splat_transform_moves.
#
# Seen on 2026-11-28 with both versions (x, y, z of a splat at 1, 2, 3):
#   --scale 2: .ply [2.0, 4.0, 6.0], .csv [1.0, 2.0, 3.0]
#   --rotate 0,0,90: .ply [-2.0, 1.0, 3.0], .csv [1.0, 2.0, 3.0]
#   --translate 0,0,10: .ply [1.0, 2.0, 13.0], .csv [1.0, 2.0, 3.0]
#   --translate 0,0,10 --filter-sphere=-1,-2,13,1: .ply [1.0, 2.0, 13.0], .csv [1.0, 2.0, 3.0]
#
# nerfbake writes no .csv of splats; its writers get splats that have been moved already.
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
import csv
import subprocess

from splat_rows import read, write

WANTED = {
    "--scale 2": [2, 4, 6],
    "--rotate 0,0,90": [-2, 1, 3],
    "--translate 0,0,10": [1, 2, 13],
    "--translate 0,0,10 --filter-sphere=-1,-2,13,1": [1, 2, 13],
}
write("in.ply", (1, 2, 3, 0))
for version in ("2.7.1", "3.7.0"):
    print(version)
    for words, wanted in WANTED.items():
        for target in ("out.ply", "out.csv"):
            program = f"{version}/node_modules/.bin/splat-transform"
            subprocess.run([program, "-w", "in.ply", *words.split(), target], check=True, capture_output=True)
        splats = read("out.ply")
        ply = [round(float(splats[name][0]), 3) for name in "xyz"]
        with open("out.csv", newline="") as file:
            row = next(csv.DictReader(file))
        table = [round(float(row[name]), 3) for name in "xyz"]
        print(f"  {words}: .ply {ply}, .csv {table}")
        assert ply == wanted and table == [1, 2, 3]
PYTHON
