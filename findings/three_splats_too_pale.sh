#!/usr/bin/env bash
# three.js 0.187.0: splats are too pale, because their sRGB colours are taken for linear light.
#
# The loaders store the colours of splats in bytes, and GaussianSplat, the class that 2026 brought, hands them on as the
# linear colour of a fragment. WebGPURenderer then converts its output to sRGB: a grey of 128 becomes 187 on the screen.
# So it is with a .glb: the loader asks for colorSpace of KHR_gaussian_splatting and uses it for nothing. With
# `renderer.outputColorSpace = LinearSRGBColorSpace` splats are right.
# Needs Chromium (Debian: chromium).
#
# Seen on 2026-11-28, with Chromium 156 (colour of the splat; pixel by default, with linear output):
#   0.5 128 187 126
#   0.2 51 123 50
#
# nerfbake's pages show the colours of the file, as PlayCanvas' viewer and Spark do.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cp "$(dirname "$0")/three_splats.py" "$(dirname "$0")/splat_rows.py" "$folder"
cd "$folder"
python3 -m venv venv
venv/bin/pip install -q --disable-pip-version-check numpy==2.4.6 plyfile==1.1.5 playwright==1.65.2
npm init -y >/dev/null
npm install --silent --no-audit --no-fund three@0.187.0
venv/bin/python - <<'PYTHON'
from plyfile import PlyData
from splat_rows import write
from three_splats import draw

for colour, pale in ((0.5, 187), (0.2, 123)):
    write("one.ply", (0, 0, 0, 12))
    ply = PlyData.read("one.ply")
    for channel in range(3):
        ply["vertex"][f"f_dc_{channel}"] = (colour - 0.5) / 0.28209479
        ply["vertex"][f"scale_{channel}"] = -1
    ply.write("in.ply")
    found = [int(each[30, 30, 0]) for each in draw("in.ply", ((0, 0, 4), ""), ((0, 0, 4), "LinearSRGBColorSpace"))]
    print(colour, round(255 * colour), *found)
    assert abs(found[0] - pale) <= 1 and abs(found[1] - 255 * colour) <= 2
PYTHON
