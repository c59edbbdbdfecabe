#!/usr/bin/env bash
# splat-transform 2.7.1 and 3.7.0: a .spz that one version writes stands upside down in the other.
#
# 2.7.1 turns splats by half a turn about x between .ply and .spz, as SPZ's README asks (right, up, back). 3.7.0 turns
# nothing. Each version reads back what it wrote itself, and neither puts its axes into the file, so no reader can tell
# the two kinds apart: the version of the program that wrote a file decides whether it is upright.
# nerfbake writes SPZ's extension that names the axes, reads it, and has --in-axes for files without it.
#
# Seen on 2026-11-28:
#   2.7.1 -> 2.7.1: [1, 2, 3]
#   2.7.1 -> 3.7.0: [1, -2, -3]
#   3.7.0 -> 2.7.1: [1, -2, -3]
#   3.7.0 -> 3.7.0: [1, 2, 3]
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

import numpy as np
from splat_rows import read, write

write("in.ply", (1, 2, 3, 0))


def convert(version, source, target):
    program = f"{version}/node_modules/.bin/splat-transform"
    subprocess.run([program, "-w", source, target], check=True, capture_output=True)


for writer in ("2.7.1", "3.7.0"):
    convert(writer, "in.ply", "made.spz")
    for reader in ("2.7.1", "3.7.0"):
        convert(reader, "made.spz", "back.ply")
        rows = read("back.ply")
        place = [int(np.rint(rows[axis][0])) for axis in "xyz"]
        print(f"{writer} -> {reader}: {place}")
        assert place == ([1, 2, 3] if writer == reader else [1, -2, -3])
PYTHON
