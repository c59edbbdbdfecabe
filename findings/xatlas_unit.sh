#!/usr/bin/env bash
# xatlas 0.0.11: parametrize() of one sphere in five units of the world.
#
# A sphere with a radius of 1, 100 or 10,000 gets UVs in 0..1. With a radius of 0.001, an object of two millimetres in
# metres, every UV is NaN and no vertex is split at a seam, without an error or a warning:
#     radius 1: 232 UVs, 0 NaN        radius 0.001: 162 UVs, 162 NaN
# Scale a mesh to about 1 before you parametrize it: UVs do not need the unit. Scenes of nerfbake have any unit.
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/env"
"$folder/env/bin/python" -m pip install --quiet --disable-pip-version-check numpy==2.4.6 xatlas==0.0.11

"$folder/env/bin/python" - <<'END'
import numpy as np
import xatlas


def sphere() -> tuple[np.ndarray, np.ndarray]:
    """An icosahedron whose faces are divided twice: 162 vertices, 320 faces."""
    phi = (1 + 5**0.5) / 2
    points = [(-1, phi, 0), (1, phi, 0), (-1, -phi, 0), (1, -phi, 0), (0, -1, phi), (0, 1, phi)]
    points += [(0, -1, -phi), (0, 1, -phi), (phi, 0, -1), (phi, 0, 1), (-phi, 0, -1), (-phi, 0, 1)]
    points = [np.array(point) / np.linalg.norm(point) for point in points]
    faces = [(0, 11, 5), (0, 5, 1), (0, 1, 7), (0, 7, 10), (0, 10, 11), (1, 5, 9), (5, 11, 4), (11, 10, 2), (10, 7, 6)]
    faces += [(7, 1, 8), (3, 9, 4), (3, 4, 2), (3, 2, 6), (3, 6, 8), (3, 8, 9), (4, 9, 5), (2, 4, 11), (6, 2, 10)]
    faces += [(8, 6, 7), (9, 8, 1)]
    for _ in range(2):
        middles, finer = {}, []
        for a, b, c in faces:
            made = []
            for one, other in ((a, b), (b, c), (c, a)):
                key = (min(one, other), max(one, other))
                if key not in middles:
                    middle = points[one] + points[other]
                    middles[key] = len(points)
                    points.append(middle / np.linalg.norm(middle))
                made.append(middles[key])
            ab, bc, ca = made
            finer += [(a, ab, ca), (b, bc, ab), (c, ca, bc), (ab, bc, ca)]
        faces = finer
    return np.array(points), np.array(faces, np.uint32)


points, faces = sphere()
for radius, broken in ((1e4, False), (100, False), (1, False), (1e-3, True), (1e-5, True)):
    rows, _, uvs = xatlas.parametrize((radius * points).astype(np.float32), faces)
    lost = int(np.isnan(uvs).any(axis=1).sum())
    print(f"radius {radius:g}: {len(rows)} UVs, {lost} NaN")
    assert (lost == len(rows)) if broken else (lost == 0 and 0 <= uvs.min() and uvs.max() <= 1)
END
