#!/usr/bin/env bash
# three.js 0.187.0: colours that spherical harmonics bring back into range are lost: their base is cut off first.
#
# A splat's colour is a base plus terms for the direction, and only the sum has to be in 0..1. The loaders store the base
# in a byte, cut off at 0 and 1, before the shader adds the terms, and each coefficient of a term in -1..1. What should
# be 1.4 - 0.44 = 0.96 is drawn as 0.56, and -0.3 + 0.44 = 0.14 as 0.44. A .spz has room for bases from -0.44 to 1.44,
# for this very reason; its loader cuts them off as well.
# Needs Chromium (Debian: chromium).
#
# Seen on 2026-11-28, with Chromium 156 (base and term; right colour and drawn colour, of 255):
#   0.5 -0.44: 15 16
#   1.4 -0.44: 245 141
#   -0.3 0.44: 36 111
#
# nerfbake adds the terms before it cuts off, also in its pages.
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
import numpy as np
from three_splats import draw

names = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", *(f"f_rest_{k}" for k in range(9)), "opacity"]
names += ["scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
head = "ply\nformat binary_little_endian 1.0\nelement vertex 1\n"
head += "".join(f"property float {name}\n" for name in names) + "end_header\n"
seen = {}
for base, coefficient in ((0.5, 0.9), (1.4, 0.9), (-0.3, -0.9)):
    row = dict.fromkeys(names, 0.0) | {"opacity": 12, "rot_0": 1} | dict.fromkeys(names[-7:-4], -1.0)
    row |= dict.fromkeys(names[3:6], (base - 0.5) / 0.28209479)
    row |= {f"f_rest_{3 * channel + 1}": coefficient for channel in range(3)}  # the term of z
    open("in.ply", "wb").write(head.encode() + np.array(list(row.values()), "<f4").tobytes())
    term = -0.48860251 * coefficient  # the camera looks along -z
    (picture,) = draw("in.ply", ((0, 0, 4), "LinearSRGBColorSpace"))
    right, drawn = round(255 * (base + term)), int(picture[30, 30, 0])
    print(f"{base} {term:.2f}: {right} {drawn}")
    assert abs(drawn - round(255 * (min(max(base, 0), 1) + term))) <= 3
PYTHON
