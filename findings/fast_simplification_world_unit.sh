#!/usr/bin/env bash
# fast-simplification 0.2.0 and 0.1.13: the unit of the world decides how many triangles are left.
#
# A sphere of 20,480 triangles is simplified to 1,500. In a world where its radius is 100, 1,500 are left; where it is
# 100,000, there are 5,432, without a warning. In small units the number is right, but corners lie three times as far
# from the sphere. The limits of the collapse are absolute numbers, so a mesh in millimetres and the same mesh in
# metres give different results.
#
# Seen on 2026-11-27, both versions alike (radius, triangles, largest distance from the sphere in radii):
#   0.01    1500 0.0091
#   100     1500 0.0027
#   100000  5432 0.0007
#
# nerfbake scales a mesh by a power of two to a size of about 100 before the call, and back after it.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cat >"$folder/run.py" <<'PYTHON'
import fast_simplification
import numpy as np
import trimesh

ball = trimesh.creation.icosphere(subdivisions=5)
counts, errors = {}, {}
for radius in (0.01, 100, 100_000):
    points, faces = fast_simplification.simplify(ball.vertices * radius, ball.faces, target_count=1500)
    counts[radius] = len(faces)
    errors[radius] = abs(np.linalg.norm(points, axis=1) / radius - 1).max()
    print(f"{radius:<8g}{counts[radius]} {errors[radius]:.4f}")
assert counts[0.01] == counts[100] == 1500 < 2 * counts[100] < counts[100_000], "the unit has no effect on the count"
assert errors[0.01] > 2 * errors[100], "the unit has no effect on the error"
PYTHON
python3 -m venv "$folder/venv"
for version in 0.1.13 0.2.0; do
    "$folder/venv/bin/pip" install -q --disable-pip-version-check \
        "fast-simplification==$version" trimesh==4.12.2 numpy==2.4.6
    echo "fast-simplification $version"
    "$folder/venv/bin/python" "$folder/run.py"
done
