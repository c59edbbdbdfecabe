#!/usr/bin/env bash
# three.js 0.187.0: small splats are too faint: each is drawn as if its scene had been trained with antialiasing.
#
# Both kinds of trainers widen a splat on the screen by 0.3 pixels squared. That of 3DGS keeps its opacity; only one
# with antialiasing (Mip-Splatting, gsplat's `antialiased`) divides it by the growth of its area, so that files of the
# two look right in different ways. three.js divides always, whether the file says `SplatRenderMode: mip` or nothing. A
# hair that a scene of 3DGS shows with 0.97 has 0.27 where its splats are a third of a pixel wide, and the farther the
# camera goes, the more is lost.
# Needs Chromium (Debian: chromium).
#
# Seen on 2026-11-28, with Chromium 156 (standard deviation in pixels; the grey in its middle that 3DGS and an
# antialiased trainer expect, and what was drawn, of 255):
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cp "$(dirname "$0")/three_splats.py" "$folder"
cd "$folder"
python3 -m venv venv
venv/bin/pip install -q --disable-pip-version-check numpy==2.4.6 playwright==1.65.2
npm init -y >/dev/null
npm install --silent --no-audit --no-fund three@0.187.0
venv/bin/python - <<'PYTHON'
import math

import numpy as np
from three_splats import draw

EDGE, AWAY, OPACITY, BLUR, WHITE = 61, 4.0, 0.97, 0.3, 0.5 / 0.28209479
FOCAL = EDGE / 2 / math.tan(math.radians(30))
names = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2"]
names += ["rot_0", "rot_1", "rot_2", "rot_3"]
for pixels, mark in ((1, ""), (0.35, ""), (0.35, "SplatRenderMode: mip")):
    head = "ply\nformat binary_little_endian 1.0\n" + (f"comment {mark}\n" if mark else "") + "element vertex 1\n"
    head += "".join(f"property float {name}\n" for name in names) + "end_header\n"
    size = math.log(pixels * AWAY / FOCAL)
    row = [0, 0, 0, WHITE, WHITE, WHITE, math.log(OPACITY / (1 - OPACITY)), size, size, size, 1, 0, 0, 0]
    open("in.ply", "wb").write(head.encode() + np.array(row, "<f4").tobytes())
    (picture,) = draw("in.ply", ((0, 0, AWAY), "LinearSRGBColorSpace"), edge=EDGE)
    kept = pixels**2 / (pixels**2 + BLUR)  # the area before, by the area after
    plain, antialiased, drawn = round(255 * OPACITY), round(255 * OPACITY * kept), int(picture[30, 30, 0])
    print(f"{pixels}{mark and ', '}{mark}: 3DGS {plain}, antialiased {antialiased}, drawn {drawn}")
    assert abs(drawn - antialiased) <= 3
PYTHON
