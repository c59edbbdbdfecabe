#!/usr/bin/env bash
# Open3D 0.20.0: splats that are rotated get harmonics up to twice as large, even if the angle is 0.
#
# rotate() of a point cloud of splats turns their centres, rotations and harmonics. A rotation keeps the length of the
# coefficients of each degree, but here it grows: m of -2 and 2 come out 1.41 times as large as they should, m of -3 and
# 3 twice. Every further rotation does it again: after four quarter turns, everything is back in its place, and a
# coefficient is 16 times its value. Degree 1 is right. transform() warns that it leaves harmonics alone.
#
# Seen on 2026-11-28 (coefficients of degrees 1 to 3 of one channel; all of them were 1):
#   once by 0 degrees:
#     [1.0, 1.0, 1.0]
#     [1.41, 1.0, 1.0, 1.0, 1.41]
#     [2.0, 1.41, 1.0, 1.0, 1.0, 1.41, 2.0]
#   four times by 90 degrees:
#     [1.0, 1.0, 1.0]
#     [4.0, 1.0, 1.0, 1.0, 4.0]
#     [16.0, 4.0, 1.0, 1.0, 1.0, 4.0, 16.0]
#
# nerfbake rotates harmonics, too; its tests check that 0 degrees change nothing, and two rotations equal their product.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install -q --disable-pip-version-check open3d==0.20.0 numpy==2.4.6 2>/dev/null
venv/bin/python - <<'PYTHON'
import numpy as np
import open3d as o3d

SHAPES = {"rot": (1, 4), "scale": (1, 3), "opacity": (1, 1), "f_dc": (1, 3), "f_rest": (1, 15, 3)}


def rotated(times, degrees):
    splats = o3d.t.geometry.PointCloud(np.zeros((1, 3), np.float32))
    for name, shape in SHAPES.items():
        splats.point[name] = np.ones(shape, np.float32)
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    for _ in range(times):
        splats.rotate(np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]]), np.zeros(3))
    red = splats.point["f_rest"].numpy()[0, :, 0]
    return [[round(float(each), 2) for each in degree] for degree in np.split(red, (3, 8))]


for word, times, degrees, second, third in (("once", 1, 0, 1.41, 2), ("four times", 4, 90, 4, 16)):
    print(f"{word} by {degrees} degrees:", *(found := rotated(times, degrees)), sep="\n  ")
    assert found == [[1, 1, 1], [second, 1, 1, 1, second], [third, second, 1, 1, 1, second, third]]
PYTHON
