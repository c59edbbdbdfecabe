#!/usr/bin/env bash
# gsplat2USD 0.1.5: to write scene.usdz deletes the scene.usda that lay beside it.
#
# A .usdz is made by way of a .usda of the same name beside it, which is removed at the end. Whoever keeps both,
# the text to look at and the package to send, loses the text, with an exit code of 0 and no line about it. If the stage
# was edited, or is another scene of the same name, nothing brings it back.
#
# Seen on 2026-11-28:
#   before: ['in.ply', 'scene.usda']
#   gsplat2USD -i in.ply -o scene.usdz: exit code 0, usda named in its output: False
#   after: ['in.ply', 'scene.usdz']
#
# nerfbake writes under a temporary name of its own, and replaces no file that it was not asked to.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cp "$(dirname "$0")/splat_rows.py" "$folder"
cd "$folder"
python3 -m venv venv
venv/bin/pip install -q --disable-pip-version-check gsplat2USD==0.1.5 usd-core==26.11 numpy==2.3.1 2>/dev/null
venv/bin/python - <<'PYTHON'
import subprocess
from pathlib import Path

from splat_rows import write

Path("work").mkdir()
write("work/in.ply", (0, 0, 0, 2), (1, 0, 0, 2))
Path("work/scene.usda").write_text('#usda 1.0\ndef Xform "Edited" {}\n')
print("before:", before := sorted(path.name for path in Path("work").iterdir()))
command = ["../venv/bin/gsplat2USD", "-i", "in.ply", "-o", "scene.usdz"]
made = subprocess.run(command, cwd="work", capture_output=True, text=True, check=True)
named = "usda" in made.stdout + made.stderr
print(f"gsplat2USD {' '.join(command[1:])}: exit code {made.returncode}, usda named in its output: {named}")
print("after:", after := sorted(path.name for path in Path("work").iterdir()))
assert (before, after, named) == (["in.ply", "scene.usda"], ["in.ply", "scene.usdz"], False)
PYTHON
