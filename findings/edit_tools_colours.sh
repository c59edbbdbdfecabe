#!/usr/bin/env bash
# 3dgs-edit-tools 0.3.0: splats that go through its table and back have other colours, although nobody edits them.
#
# 3dgs-to-csv maps the base colours of a scene, from the lowest coefficient to the highest, to 0..1 for those who edit
# them, and writes neither number into the table. csv-to-3dgs maps 0..1 to -3..3, so the contrast of each scene
# changes by a factor that its most extreme splat decides. In Python, a variable of the module remembers the range of
# the scene that was read last, and the table of any other scene gets that one. So merge_3dgs_files() puts the first
# scene into the colours of the second. Its option to scale, which the program sets to 1, 1, 1 unless told otherwise,
# begins at the unmoved places again: a translation does nothing.
# Guess: float32 comes back from text as it was; a merge leaves both scenes as they are, and moves the second by 5.
#
# Seen on 2026-11-28 (the coefficient f_dc_0 of two dark and two bright splats; x of the second scene):
#   dark.ply: [-1.5, -0.5], after both programs: [-3.0, 3.0]
#   bright.ply: [0.5, 1.5], after both programs: [-3.0, 3.0]
#   both tables made, then both restored: dark [0.5, 1.5], bright [0.5, 1.5]
#   merged: [0.5, 1.5, 0.5, 1.5]
#   --translate-x 5: the second scene is at [7.0, 7.0], which was at [7.0, 7.0]
#
# nerfbake has no table of splats.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cp "$(dirname "$0")/splat_rows.py" "$folder"
cd "$folder"
python3 -m venv venv
venv/bin/pip install -q --disable-pip-version-check 3dgs-edit-tools==0.3.0 numpy==2.4.6 pandas==2.3.3 \
  matplotlib==3.10.7 open3d-cpu==0.20.0 2>/dev/null
cat >scenes.py <<'PYTHON'
import numpy as np
from splat_rows import NAMES, write

for name, x, colours in (("dark", 0, (-1.5, -0.5)), ("bright", 7, (0.5, 1.5))):
    write(f"{name}.ply", *((x, 0, 0, 2) for _ in colours))
    with open(f"{name}.ply", "r+b") as file:
        head, _, body = file.read().partition(b"end_header\n")
        table = np.frombuffer(body, "<f4").reshape(2, -1).copy()
        table[:, NAMES.index("f_dc_0") : NAMES.index("f_dc_2") + 1] = np.array(colours)[:, None]
        file.seek(len(head) + len(b"end_header\n"))
        file.write(table.tobytes())
PYTHON
venv/bin/python scenes.py
for name in dark bright; do
  venv/bin/3dgs-to-csv $name.ply --output_csv $name.csv >log
  venv/bin/csv-to-3dgs $name.csv --output_ply $name.restored.ply >log
done
venv/bin/python -m src.merge_gs dark.ply bright.ply --output moved.ply --translate-x 5 >log 2>&1
venv/bin/python - <<'PYTHON'
import contextlib
import io

from splat_rows import read
from src import convert_3dgs_to_csv, convert_csv_to_3dgs, merge_3dgs_files


def column(path, name="f_dc_0"):
    return read(path)[name].round(4).tolist()


for name, expected in (("dark", [-1.5, -0.5]), ("bright", [0.5, 1.5])):
    before, after = column(f"{name}.ply"), column(f"{name}.restored.ply")
    print(f"{name}.ply: {before}, after both programs: {after}")
    assert (before, after) == (expected, [-3, 3])
with contextlib.redirect_stdout(io.StringIO()):
    for name in ("dark", "bright"):
        convert_3dgs_to_csv(f"{name}.ply", f"{name}.table.csv")
    for name in ("dark", "bright"):
        convert_csv_to_3dgs(f"{name}.table.csv", None, f"{name}.again.ply")
    merge_3dgs_files("dark.ply", "bright.ply", "merged.ply")
dark, bright, merged = column("dark.again.ply"), column("bright.again.ply"), column("merged.ply")
print(f"both tables made, then both restored: dark {dark}, bright {bright}")
print(f"merged: {merged}")
places = column("moved.ply", "x")[2:]
print(f"--translate-x 5: the second scene is at {places}, which was at {column('bright.ply', 'x')}")
assert dark == bright == [0.5, 1.5]
assert merged == [0.5, 1.5, 0.5, 1.5]
assert places == column("bright.ply", "x") == [7, 7]
PYTHON
