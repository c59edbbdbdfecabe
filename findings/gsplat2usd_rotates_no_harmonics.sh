#!/usr/bin/env bash
# gsplat2USD 0.1.5: splats that are rotated into USD keep their spherical harmonics, so colours face the other way.
#
# A .ply of 3DGS has y down; the converter's own documentation names a rotation of 180, 0, 0 for it. Centres and
# orientations are turned, coefficients are copied. A splat that is red from above and dark from below, in the world
# of the capture, is dark from above in the stage. Nothing is said: each attribute is valid, and a scene of degree 0 is
# right. `--up-axis` turns nothing at all.
#
# Seen on 2026-11-28 (red of the splat, 0 to 1, by the harmonics of the file):
#   .ply, y down: from above 0.84, from below 0.16
#   .usda of --rotate-x 180, y up: from above 0.16, from below 0.84
#   orientation: (0.7071, 0.0, 0.0, 0.7071) became (0.0, 0.7071, -0.7071, 0.0)
#
# nerfbake turns the harmonics with the splats (`convert --in-up`), and to USD's y by itself.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install -q --disable-pip-version-check gsplat2USD==0.1.5 usd-core==26.11 numpy==2.3.1 2>/dev/null
venv/bin/python - <<'PYTHON'
import numpy as np

names = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", *(f"f_rest_{k}" for k in range(9)), "opacity"]
names += ["scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
row = dict.fromkeys(names, 0.0) | {"x": 1, "y": 2, "z": 3, "f_rest_0": -0.7, "rot_0": 0.5**0.5, "rot_3": 0.5**0.5}
head = "ply\nformat binary_little_endian 1.0\nelement vertex 1\n"
head += "".join(f"property float {name}\n" for name in names) + "end_header\n"
open("in.ply", "wb").write(head.encode() + np.array(list(row.values()), "<f4").tobytes())
PYTHON
venv/bin/gsplat2USD -i in.ply -o out.usda --rotate-x 180 >log
venv/bin/python - <<'PYTHON'
from pxr import Usd

ABOVE, BELOW = 1, -1  # the height of the eye over the splat


def red(coefficients, y):
    """The red of a splat seen along (0, y, 0), by the formula of 3DGS: its first term goes with -y."""
    return round(0.5 + 0.28209479 * coefficients[0] - 0.48860251 * y * coefficients[1], 2)


stage = Usd.Stage.Open("out.usda")
splats = stage.GetDefaultPrim()
value = {name: splats.GetAttribute(name).Get() for name in ("positions", "orientations")}
assert [round(x, 5) for x in value["positions"][0]] == [1, -2, -3]
found = [x[0] for x in splats.GetAttribute("radiance:sphericalHarmonicsCoefficients").Get()]
ply = {"above": red([0, -0.7], ABOVE), "below": red([0, -0.7], BELOW)}  # y is down: who looks from above looks along +y
usd = {"above": red(found, -ABOVE), "below": red(found, -BELOW)}
turned = value["orientations"][0]
print(f".ply, y down: from above {ply['above']}, from below {ply['below']}")
print(f".usda of --rotate-x 180, y up: from above {usd['above']}, from below {usd['below']}")
turned = tuple(round(x, 4) + 0.0 for x in (turned.real, *turned.imaginary))
print(f"orientation: (0.7071, 0.0, 0.0, 0.7071) became {turned}")
assert turned == (0, 0.7071, -0.7071, 0)
assert ply == {"above": 0.84, "below": 0.16} and usd == {"above": 0.16, "below": 0.84}
PYTHON
