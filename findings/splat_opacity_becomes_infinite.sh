#!/usr/bin/env bash
# gaussforge 0.6.0 and splat-transform 3.7.0: an opaque splat of a .spz has two logits, 13.8 and infinity.
#
# A .spz has eight bits for an opacity, and a .ply of 3DGS its logit. A splat with a logit of 20 is stored as 255, which
# is 1. Back in a .ply, gaussforge writes infinity for it, splat-transform 13.8. Trainers that continue from the former
# get NaN with the first step, and readers that drop rows with numbers that are not finite lose all opaque splats.
#
# Seen on 2026-11-27 (logits of the .ply that each program made of its own .spz):
#   splat-transform: [0.0078, 13.8155]
#   gaussforge: [0.0078, inf]
#
# nerfbake reads infinite logits as opacities of 0 and 1, and writes no infinity.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cp "$(dirname "$0")/splat_rows.py" "$folder"
cd "$folder"
python3 -m venv venv
venv/bin/pip install -q --disable-pip-version-check gaussforge==0.6.0 numpy==2.4.6
npm init -y >/dev/null
npm install --silent --no-audit --no-fund @playcanvas/splat-transform@3.7.0
venv/bin/python -c 'from splat_rows import write; write("in.ply", (0, 0, 0, 0), (1, 0, 0, 20))'
node_modules/.bin/splat-transform -w in.ply a.spz >log 2>&1
node_modules/.bin/splat-transform -w a.spz a.ply >log 2>&1
venv/bin/python - <<'PYTHON' 2>log
import gaussforge
import numpy as np
from splat_rows import read

forge = gaussforge.GaussForge()
packed = forge.convert(open("in.ply", "rb").read(), "ply", "spz")["data"]
open("b.ply", "wb").write(forge.convert(packed, "spz", "ply")["data"])
found = {name: read(path)["opacity"] for name, path in (("splat-transform", "a.ply"), ("gaussforge", "b.ply"))}
for name, logits in found.items():
    print(f"{name}: {[round(float(logit), 4) for logit in logits]}")
assert np.isinf(found["gaussforge"][1]) and 13 < found["splat-transform"][1] < 14
PYTHON
